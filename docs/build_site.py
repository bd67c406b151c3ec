"""Builds the documentation as a site in build/docs, strictly: a dead link is an error. Run by `make docs`.

Every page is found by listing the folders, so a new one needs no line anywhere; `FIRST` only says what comes first.
"""

from __future__ import annotations

import argparse
import logging
import re
import shutil
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FIRST = ("quickstart", "recipes", "loading", "format", "metrics", "accuracy", "glossary", "errors", "clusters", "scale")
TOP = ("README.md", "LICENSE")
SHOWN = ("*.md", "*.png", "*.svg", "*.ipynb", "*.json", "*.py", "*.yaml", "*.yml")  # what pages are, show and link to
FOLDERS = ("docs", "train", "benchmarks", "schemas", "recipes", "dapdata")


def copy_pages(to: Path) -> None:
    """Copies the pages, and all that they could show or link to, with the folders that they are in."""
    shutil.rmtree(to, ignore_errors=True)
    below = (path for folder in FOLDERS for pattern in SHOWN for path in (ROOT / folder).rglob(pattern))
    for path in (*(ROOT / name for name in TOP), *below):
        target = to / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)


def title(page: Path) -> str:
    """The heading of a page."""
    found = re.search(r"^# (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return found.group(1) if found else page.stem


def navigation(pages: Path) -> list[dict[str, Any]]:
    """What the site lists, as mkdocs wants it: {title: path}."""

    def entry(path: Path) -> dict[str, Any]:
        return {title(path): path.relative_to(pages).as_posix()}

    found = {path.stem: path for path in sorted((pages / "docs").glob("*.md"))}
    ordered = [found.pop(name) for name in FIRST if name in found] + list(found.values())
    others = sorted(path for folder in FOLDERS[1:] for path in (pages / folder).rglob("*.md"))
    return [entry(path) for path in (pages / "README.md", *ordered, *others)]


def build(to: Path) -> None:
    """Builds the site into a folder; exits with 1 after naming every dead link and every page that is left out."""
    from mkdocs.commands.build import build as build_site
    from mkdocs.config import load_config
    from mkdocs.exceptions import Abort

    pages = to.parent / "pages"
    copy_pages(pages)
    places = {"docs_dir": str(pages), "site_dir": str(to)}
    config = load_config(str(ROOT / "docs/mkdocs.yml"), nav=navigation(pages), **places)
    counter = _count_warnings()
    try:
        build_site(config)
    except Abort as error:
        sys.exit(str(error))
    if counter.warnings:
        sys.exit(f"{to}: {counter.warnings} warnings, expected none")
    print(to / "index.html")


class _Counter(logging.Handler):
    """Tells what mkdocs has to say, and counts it."""

    warnings = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.warnings += record.levelno >= logging.WARNING
        print(f"{record.levelname.lower()}: {record.getMessage()}", file=sys.stderr)


def _count_warnings() -> _Counter:
    counter = _Counter(logging.WARNING)
    logging.getLogger("mkdocs").addHandler(counter)
    return counter


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--to", type=Path, default=ROOT / "build/docs", help="folder of the site; pages are copied beside it")
    build(parser.parse_args().to)
