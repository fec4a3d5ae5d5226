"""Writes `docs/plugins/NAME.md` from the docstrings of the plugins: `python docs/plugin_pages.py` (`--check` only
compares, and exits with 1 when a page is out of date)."""

import ast
import re
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_KINDS = {
    "BSDF": "BSDF",
    "Emitter": "Emitter",
    "Mesh": "Shape",
    "SamplingIntegrator": "Integrator",
    "Texture": "Texture",
}


def plugin_docstring(source: str) -> tuple[str, str]:
    """The kind of plugin that a file defines, and its class's docstring."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef) and node.bases:
            base = getattr(node.bases[0], "attr", None)
            if base in _KINDS:
                return _KINDS[base], ast.get_docstring(node) or ""
    raise ValueError("no plugin class in the file")


def _parameter_table(block: str) -> str:
    """A `pluginparameters` list as a Markdown table."""
    rows = ["| parameter | type | meaning | |", "| --- | --- | --- | --- |"]
    for entry in re.split(r"^\s*\* - ", block, flags=re.MULTILINE)[1:]:
        cells = [" ".join(cell.split()) for cell in re.split(r"^\s*- ", entry, flags=re.MULTILINE)]
        cells = [re.sub(r"\|(\w+)\|", r"\1", cell).replace("|", "\\|") for cell in cells]
        rows.append("| " + " | ".join((cells + [""] * 4)[:4]) + " |")
    return "\n".join(rows)


def to_markdown(name: str, kind: str, docstring: str) -> str:
    """A page from a docstring in the form of Mitsuba's plugin manuals."""
    match = re.search(r"\.\. pluginparameters::\n\n(.*?)(?=^\S)", docstring, flags=re.DOTALL | re.MULTILINE)
    table = _parameter_table(match.group(1)) if match else ""
    body = docstring[match.end() :] if match else docstring
    body = re.sub(r"\.\. tabs::\s*\n", "", body)
    parts = re.split(r"^( *)\.\. code-(?:tab|block):: python\s*\n", body, flags=re.MULTILINE)
    text = parts[0].strip()
    for code in parts[2::2]:
        lines = textwrap.dedent(code.strip("\n")).strip()
        text += f"\n\n```python\n{lines}\n```"
    text = re.sub(r"^    (?=\S)", "        ", text, flags=re.MULTILINE) if "```" not in text else text
    source = f"Source of this page: the docstring in [`plugins/{name}.py`](../../plugins/{name}.py)."
    return f"# {kind} `{name}`\n\n{table}\n\n{text}\n\n{source}\n"


def pages() -> dict[Path, str]:
    """All pages by path."""
    result = {}
    for path in sorted((ROOT / "plugins").glob("[!_]*.py")):
        kind, docstring = plugin_docstring(path.read_text(encoding="utf-8"))
        result[ROOT / "docs" / "plugins" / f"{path.stem}.md"] = to_markdown(path.stem, kind, docstring)
    return result


def main() -> int:
    stale = 0
    for path, text in pages().items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            stale += 1
            if "--check" not in sys.argv:
                path.parent.mkdir(exist_ok=True)
                path.write_text(text, encoding="utf-8")
            print(f"{path.relative_to(ROOT)} was out of date")
    return 1 if stale and "--check" in sys.argv else 0


if __name__ == "__main__":
    sys.exit(main())
