"""Pages of the site that follow from the code or stand elsewhere; mkdocs calls it as a hook.

The start page is README.md. The API has a page for every folder of both packages, the launch files
and the verbs have one each, so that a search finds every argument and option.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PACKAGES = ("l2lidar_node", "l2lidar_proc")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not in docs/."""
    pages = {
        "index.md": _moved("README.md"),
        "contributing.md": _moved("CONTRIBUTING.md"),
        "reference/launch.md": "# Launch files\n\n" + "\n".join(_launch_files()),
        "reference/verbs.md": "# Verbs of `l2lidar`\n\n" + "\n".join(_verbs()),
        **dict(_api()),
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def _moved(name: str) -> str:
    """Return a page of the root with its links as seen from docs/."""
    text = (ROOT / name).read_text()
    text = text.replace("](docs/", "](").replace("](CONTRIBUTING.md)", "](contributing.md)")
    return re.sub(r"\]\((README\.md)\)", "](index.md)", text)


def _launch_files() -> Iterator[str]:
    """Yield a section for each launch file: its docstring and its arguments."""
    for path in sorted((ROOT / "launch").glob("*.launch.py")):
        tree = ast.parse(path.read_text())
        constants = {
            node.targets[0].id: node.value.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Assign)
            and isinstance(node.targets[0], ast.Name)
            and isinstance(node.value, ast.Constant)
        }
        yield f"## {path.name}\n\n{ast.get_docstring(tree) or ''}\n"
        yield f"```console\nros2 launch l2lidar_node {path.name}\n```\n"
        rows = []
        for call in ast.walk(tree):
            name = getattr(getattr(call, "func", None), "id", "")
            if isinstance(call, ast.Call) and name == "DeclareLaunchArgument":
                words = {item.arg: item.value for item in call.keywords}
                first = call.args[0] if call.args else words.get("name")
                rows.append(
                    f"| `{_text(first, constants)}` "
                    f"| {_code(words.get('default_value'), constants)} "
                    f"| {_text(words.get('description'), constants)} |"
                )
        if rows:
            yield "| Argument | Default | Description |\n|---|---|---|"
            yield "\n".join(rows) + "\n"


def _text(node: ast.AST | None, constants: dict[str, Any]) -> str:
    """Return an expression's value as far as constants tell it, else the expression."""
    if node is None:
        return ""
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(item, constants) for item in node.values)
    if isinstance(node, ast.FormattedValue):
        return _text(node.value, constants)
    if isinstance(node, ast.Name) and node.id in constants:
        return str(constants[node.id])
    try:
        return str(ast.literal_eval(node))
    except ValueError:
        return ast.unparse(node)


def _code(node: ast.AST | None, constants: dict[str, Any]) -> str:
    text = _text(node, constants)
    return f"`{text}`" if text else ""


def _verbs() -> Iterator[str]:
    """Yield a section for each verb: what its --help says."""
    from typer.testing import CliRunner

    from l2lidar_node.cli.main import VERBS, app
    from l2lidar_node.command_line import registered_verbs

    runner = CliRunner()
    environment = {"COLUMNS": "110", "TERMINAL_WIDTH": "110", "NO_COLOR": "1", "TERM": "dumb"}
    for verb in [*VERBS, *registered_verbs()]:
        for words in ([verb.name], *([verb.name, name] for name in _below(verb))):
            done = runner.invoke(app(), [*words, "--help"], prog_name="l2lidar", env=environment)
            lines = [line.rstrip() for line in done.output.splitlines()]
            text = "\n".join(line for line in lines if line)
            yield f"## l2lidar {' '.join(words)}\n\n```text\n{text}\n```\n"


def _below(verb: Any) -> list[str]:
    return list(getattr(verb.load(), "commands", {}))


def _api() -> Iterator[tuple[str, str]]:
    """Yield a page for each folder of the packages, and one for the modules beside the folders."""
    for package in PACKAGES:
        folders = sorted(
            path.name
            for path in (ROOT / package).iterdir()
            if (path / "__init__.py").exists() and path.name not in ("ros", "demo")
        )
        for folder in folders:
            name = f"{package}.{folder}"
            yield f"api/{name}.md", f"# {name}\n\n::: {name}\n"
        modules = sorted(
            path.stem for path in (ROOT / package).glob("*.py") if not path.stem.startswith("__")
        )
        sections = [f"## {package}.{name}\n\n::: {package}.{name}\n" for name in modules]
        links = [f"* [{package}.{folder}]({package}.{folder}.md)" for folder in folders]
        yield f"api/{package}.md", f"# {package}\n\n" + "\n".join([*links, "", *sections])
