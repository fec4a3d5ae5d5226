"""The documentation keeps up with the code."""

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def _plugin_pages():
    spec = importlib.util.spec_from_file_location("plugin_pages", ROOT / "docs" / "plugin_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_plugin_pages_are_those_of_the_docstrings():
    """`docs/plugins` is what `python docs/plugin_pages.py` writes."""
    for path, text in _plugin_pages().pages().items():
        assert path.read_text(encoding="utf-8") == text, f"run python docs/plugin_pages.py ({path.name})"


def test_links_and_equation_table_point_at_what_exists():
    """Relative links of every page lead somewhere, and every function named in the architecture's table is defined."""
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
    table = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("## Where each equation is")[1]
    for module, name in re.findall(r"`((?:fields|models|sg|fit)\.\w+)\.(?:\w+\.)?(\w+)`", table.split("## Three")[0]):
        source = (ROOT / "sira_mi" / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")
        assert f"def {name}(" in source, f"{module}.{name}"


def test_the_collection_page_lists_the_arrays_of_a_scene():
    """The table of `docs/collection.md` is `LAYOUT`."""
    from sira_mi.training.collection.scene import LAYOUT

    page = (ROOT / "docs" / "collection.md").read_text(encoding="utf-8")
    for name, content in LAYOUT.items():
        assert f"| `{name}` | {content} |" in page, name
