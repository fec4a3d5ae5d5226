"""The packages of the wheel: those found in `sira_mi/`, and two folders of the root that install inside it. The rest is
in `pyproject.toml`, which cannot combine the two."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["sira_mi*"]), "sira_mi.plugins", "sira_mi.scenes"],
    package_dir={"sira_mi.plugins": "plugins", "sira_mi.scenes": "scenes"},
)
