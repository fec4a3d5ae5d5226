"""The documentation agrees with the code: plugin pages, links, names, commands, the equation table, README snippets."""

import ast
import importlib.util
import re
from pathlib import Path

import mitsuba as mi
import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("scenes/**/*.md"), ROOT / "studies" / "README.md"]
HISTORY = "CHANGELOG.md"
SOURCES = [
    p
    for f in ("sira_mi", "plugins", "studies", "scenes")
    for p in (ROOT / f).rglob("*.*")
    if p.suffix in (".py", ".xml")
]
EQUATIONS = ["1", "2a", "2b", "3", "4", "5", "6", "7", "8", "9a", "9b", "10", "11", "12", "13"]


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _plugin_pages():
    spec = importlib.util.spec_from_file_location("plugin_pages", ROOT / "docs" / "plugin_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _module_file(parts: list[str]) -> Path | None:
    """The file or folder of a dotted module of the project."""
    folder = ROOT / "plugins" if parts[:2] == ["sira_mi", "plugins"] else ROOT / parts[0]
    path = folder.joinpath(*parts[2 if folder.name == "plugins" else 1 :])
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def _definition(dotted: str) -> ast.AST | None:
    """The syntax tree of a module, or of the class, function or assignment in it, that a dotted name leads to."""
    parts = dotted.split(".")
    for split in range(len(parts), 0, -1):
        if file := _module_file(parts[:split]):
            node: ast.AST | None = ast.parse(_read(file))
            for name in parts[split:]:
                node = next((child for child in node.body if name in _names(child)), None) if node else None
            return node
    return None


def _names(node: ast.AST) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    if isinstance(node, ast.ImportFrom):
        return [alias.asname or alias.name for alias in node.names]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [n.id for target in targets if target for n in ast.walk(target) if isinstance(n, ast.Name)]


def _cited_equations(text: str) -> set[str]:
    """The equations that a text cites: "eq. 8", "Eqs 1 and 2a", "eqs 9a, 9b", "eqs 1–3"."""
    cited = set()
    for phrase in re.findall(r"\b[Ee]qs?\.? (\d+[ab]?(?:(?:, | and |–|-)\d+[ab]?)*)", text):
        for part in re.split(r", | and ", phrase):
            ends = re.split("[–-]", part)
            numbers = [i for end in ends for i, e in enumerate(EQUATIONS) if e.rstrip("ab") == end or e == end]
            cited |= set(EQUATIONS[min(numbers, default=0) : max(numbers, default=-1) + 1])
    return cited


def test_plugin_pages_are_those_of_the_docstrings():
    """`docs/plugins` is what `python docs/plugin_pages.py` writes."""
    for path, text in _plugin_pages().pages().items():
        assert _read(path) == text, f"run python docs/plugin_pages.py ({path.name})"


def _anchors(page: Path) -> list[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)", _read(page), re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]


def _missing_names(text: str) -> list[str]:
    """The commands, modules, functions and paths in a text that do not exist; NAME and * stand for any."""
    missing = []
    for command in re.findall(r"python -m ((?:sira_mi|studies)(?:\.\w+)*)", text):
        file = _module_file([*command.split("."), "__main__"]) or _module_file(command.split("."))
        if "NAME" not in command and (file is None or file.name == "__init__.py"):
            missing.append(f"python -m {command}")
    missing += [n for n in re.findall(r"`((?:sira_mi|studies)(?:\.\w+)+)`", text) if not _definition(n)]
    paths = re.findall(r"(?:`|python )((?:sira_mi|plugins|studies|docs|tests|scenes)/[\w./-]*)", text)
    paths += [f"tests/{name}" for name in re.findall(r"\b(test_\w+\.py)", text)]
    return missing + [path for path in paths if "NAME" not in path and not (ROOT / path).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_names_and_commands_exist(page):
    """Links of a page lead to files and headings; the modules, commands and paths that it names exist."""
    text = _read(page)
    missing = []
    for target, heading in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", text):
        file = page.parent / target if target else page
        if not file.exists() or (heading and heading not in _anchors(file)):
            missing.append(f"{target}#{heading}")
    if page.name != HISTORY:
        missing += _missing_names(text)
    assert not missing


def test_names_in_the_sources_exist():
    """Docstrings, messages and scene files name commands, modules and paths that exist."""
    missing = {str(path.relative_to(ROOT)): _missing_names(_read(path)) for path in SOURCES}
    assert not {path: names for path, names in missing.items() if names}


def test_each_equation_is_in_one_place():
    """The table of `docs/architecture.md` names every equation once; each function in it exists and cites its own."""
    section = _read(ROOT / "docs" / "architecture.md").split("## Where each equation is")[1].split("\n## ")[0]
    found = []
    for equations, functions in re.findall(r"^\| (\d[^:|]*)[^|]*\| ([^|]*) \|$", section, re.M):
        row = re.split(", ", equations)
        found += row
        for name in re.findall(r"`([\w.]+)`", functions):
            node = _definition(f"sira_mi.{name}")
            assert isinstance(node, ast.FunctionDef), name
            cited = _cited_equations(ast.get_docstring(node) or "")
            assert set(row) <= cited, f"{name} cites {sorted(cited)}, not all of {row}"
    assert found == EQUATIONS


@pytest.mark.slow
def test_readme_snippets_run(avatar_path, tmp_path, monkeypatch):
    """The Python of README runs as printed, but for the avatar's path and the size of the picture."""
    from sira_mi.sg.lights_io import write_lights
    from studies.initial_lobes import initial_lobes

    monkeypatch.chdir(tmp_path)
    (tmp_path / "me").mkdir()
    (tmp_path / "me" / "avatar.safetensors").write_bytes(Path(avatar_path).read_bytes())
    write_lights(tmp_path / "me" / "lights.json", initial_lobes(4))
    names: dict = {}
    first, second = re.findall(r"```python\n(.*?)```", _read(ROOT / "README.md"), re.DOTALL)
    exec(first.replace("spp=64", "spp=1, width=16, height=16, voxel=0.2"), names)
    mi.Thread.wait_for_tasks()
    assert (tmp_path / "head.png").stat().st_size
    exec(second, names)
    assert "head.z_sdf" in names["params"]
    image = mi.render(names["scene"], names["params"], spp=1, sensor=0)
    assert image.shape[2] == 3


def test_the_collection_page_lists_the_arrays_of_a_scene():
    """The table of `docs/collection.md` is `LAYOUT`."""
    from sira_mi.training.collection.scene import LAYOUT

    page = _read(ROOT / "docs" / "collection.md")
    for name, content in LAYOUT.items():
        assert f"| `{name}` | {content} |" in page, name
