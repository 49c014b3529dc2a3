"""The documents and the package agree: every public name has its entry, every picture is made by code."""

from __future__ import annotations

import importlib
import inspect
import re
import shlex
from pathlib import Path

import pytest
import typer

import ssm_decouple as ssm
from ssm_decouple.cli import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
REFERENCE = "\n".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "reference").glob("*.md")))
ENTRIES = re.findall(r"^::: ssm_decouple\.([\w.]+)$", REFERENCE, re.MULTILINE)
SCRIPTS = (*sorted(DOCS.glob("*.py")), ROOT / "benchmarks" / "reactionless.py")
DRAWS = "\n".join(script.read_text(encoding="utf-8") for script in SCRIPTS)
PAGES = sorted(DOCS.rglob("*.md"))


def found(path):
    """Return what an entry of the reference names."""
    module, name = ssm, path
    if "." in path:
        place, name = path.rsplit(".", 1)
        module = importlib.import_module(f"ssm_decouple.{place}")
    return getattr(module, name)


def names_of(module):
    """Return the classes and functions of a module that is public as a whole."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (inspect.isclass(value) or inspect.isfunction(value))
        and value.__module__.startswith("ssm_decouple.")
    ]


def test_every_public_name_has_its_entry_in_the_reference():
    modules = {name for name in ssm.__all__ if inspect.ismodule(getattr(ssm, name))}
    public = set(ssm.__all__) - modules - {"__version__"}
    public |= {f"{module}.{name}" for module in modules for name in names_of(getattr(ssm, module))}
    assert public - set(ENTRIES) == set()
    assert len(ENTRIES) == len(set(ENTRIES))


@pytest.mark.parametrize("path", [entry for entry in ENTRIES if "." in entry])
def test_every_entry_of_a_module_is_there_and_described(path):
    if path.startswith("control.pink"):
        pytest.importorskip("pink")
    assert inspect.getdoc(found(path))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_every_picture_is_there_and_made_by_code(page):
    text = page.read_text(encoding="utf-8")
    saved = set(re.findall(r'savefig\("(\w+)\.png"', text))
    drawn = set(re.findall(r'"(\w+)(?:": \w+\.\w+\(|\.png")', DRAWS))
    shown = set(re.findall(r"!\[[^\]]+\]\(images/(\w+)\.png\)", text))
    assert shown <= saved | drawn
    assert saved <= shown
    assert all((DOCS / "images" / f"{name}.png").exists() for name in shown)


def test_every_page_is_in_the_navigation():
    config = (ROOT / "zensical.toml").read_text(encoding="utf-8")
    assert {str(page.relative_to(DOCS)) for page in PAGES} == set(re.findall(r'= "([\w/]+\.md)" }', config))


def test_the_readme_tells_what_the_reactionless_page_found():
    readme, page = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/reactionless.md"))
    count = re.search(r"From the cases' starts, ([\d,]+) targets each", page)[1]
    found = {
        law: (share, told)
        for law, share, told in re.findall(r"\| case1 \| (\w+) \| \d \| ([\d.]+) \| ([^|]+) \|", page)
    }
    claim = re.search(r"Of ([\d,]+) random targets.*?under reactionless control", readme, re.DOTALL)
    assert claim[1] == count
    assert f"{found['none'][0]} % with\nnothing" in claim[0]
    for law in ("selective", "reactionless"):
        share, told = found[law]
        assert re.search(rf"{share} % \((95 % interval )?{told}\)", claim[0]), law


def helps(command):
    """Return the help texts of a command and of all below it."""
    below = getattr(command, "commands", {}).values()
    return [command.help or "", *(text for each in below for text in helps(each))]


def written_commands():
    """Return every command line in the documents and in the help, without its comment."""
    lines = []
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES):
        lines += re.findall(r"^(?: {4}|\$ |)(ssm-decouple .*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    for text in helps(typer.main.get_command(app)):
        examples = re.findall(r"Examples?: (.*?)(?:\n\n|$)", text, re.DOTALL)
        lines += [part for part in " ".join(examples).split(";") if part.split()[:1] == ["ssm-decouple"]]
    return sorted({" ".join(line.split("#")[0].split()) for line in lines})


@pytest.mark.parametrize("line", written_commands())
def test_every_command_that_is_shown_is_one(line):
    """Its words, options and what they need are those of the command, which is not run."""
    program, *words = shlex.split(line)
    command, context = typer.main.get_command(app), None
    while True:
        context = command.make_context(program, words, parent=context)
        if not hasattr(command, "resolve_command"):
            break
        program, command, words = command.resolve_command(context, [*context._protected_args, *context.args])
