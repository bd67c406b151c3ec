"""YAML read without surprises: the line of every key, duplicate keys refused, nothing constructed.

The text is composed to nodes, never to objects, so no tag can name Python code. Anchors and aliases are refused
(a recipe needs none, and they are how small files become huge ones). Scalars follow YAML 1.2's core schema, in
which `1e-3` is a number and `no` is a word; PyYAML's own 1.1 rules have it the other way round.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from dapdata.errors import RecipeError

MAX_BYTES = 256_000  # a recipe has some 5 kB; more is not a recipe
MAX_DEPTH = 16  # sections nest three deep
INTEGER = re.compile(r"[-+]?[0-9]{1,300}")
NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
WORDS = {
    "true": True,
    "false": False,
    "null": None,
    "~": None,
    "": None,
    ".nan": float("nan"),
    ".inf": float("inf"),
    "+.inf": float("inf"),
    "-.inf": -float("inf"),
}

Location = tuple[str | int, ...]


class Source:
    """What a file holds (`tree`), where each key of it was written, and what is wrong with it."""

    def __init__(self, origin: str, tree: dict[str, Any] | None = None) -> None:
        self.origin = origin
        self.tree: dict[str, Any] = tree if tree is not None else {}
        self.lines: dict[Location, int] = {}
        self._overrides: dict[Location, str] = {}
        self._problems: list[tuple[int, str]] = []

    def read(self, path: Path) -> None:
        """Fills the tree from a YAML file; raises RecipeError if that is no mapping, or no YAML at all."""
        node = self._compose(_text(path))
        if not isinstance(node, yaml.MappingNode):
            self._refuse(node.start_mark.line if node else None, "no mapping, expected sections such as `scene:` and `label:`")
        else:
            self.tree = self._build(node, ())
        self.stop_if_wrong()

    def override(self, assignment: str) -> None:
        """Applies `a.b=value`, its value read as YAML; raises RecipeError if it is no such thing."""
        name, equals, text = assignment.partition("=")
        path: Location = tuple(name.strip().split("."))
        if not equals or not all(path):
            raise RecipeError(f"--set {assignment}: expected KEY=VALUE, such as --set label.eps_place=0.02")
        inner = Source(f"--set {assignment}")
        node = inner._compose(text)
        value = inner._build(node, path) if node is not None else None
        inner.stop_if_wrong()
        place = self.tree
        for part in path[:-1]:
            if place.get(str(part)) is None:
                place[str(part)] = {}
            place = place[str(part)]
            if not isinstance(place, dict):
                raise RecipeError(f"--set {assignment}: {part} is no section, expected a key such as label.eps_place")
        place[str(path[-1])] = value
        self.lines = {at: line for at, line in self.lines.items() if at[: len(path)] != path}
        self._overrides[path] = assignment

    def blame(self, path: Location, text: str) -> None:
        """Notes a problem at the key `path`; its place is the key's, or that of the nearest section around it."""
        place, line = self._place(path)
        self._problems.append((line, f"{place}: {dotted(path)}: {text}"))

    def _place(self, path: Location) -> tuple[str, int]:
        """Where a key was written, as text and as a line to sort by."""
        for prefix in (path[:n] for n in range(len(path), -1, -1)):
            if prefix in self._overrides:
                return f"--set {self._overrides[prefix]}", 0
            if prefix == path and path not in self.lines:  # a section that only an override has made
                made = [name for at, name in self._overrides.items() if at[: len(path)] == path]
                if made:
                    return f"--set {made[0]}", 0
            if prefix in self.lines:
                return f"{self.origin}:{self.lines[prefix]}", self.lines[prefix]
        return self.origin, 0

    def stop_if_wrong(self) -> None:
        """Raises one RecipeError with all problems noted, a line each, in the order of the file."""
        if self._problems:
            raise RecipeError("\n".join(dict.fromkeys(text for _, text in sorted(self._problems, key=lambda p: p[0]))))

    def _refuse(self, line: int | None, text: str) -> None:
        """Raises the error of a file that cannot be read on; lines count from 0."""
        place = "" if line is None or self.origin.startswith("--set") else f":{line + 1}"
        raise RecipeError(f"{self.origin}{place}: {text}")

    def _compose(self, text: str) -> yaml.Node | None:
        """The YAML as nodes, None if there is nothing in it."""
        try:
            self._refuse_tricks(text)
            return yaml.compose(text, Loader=yaml.BaseLoader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            why = " ".join(str(error.problem or error.context).split())
            self._refuse(mark.line if mark else None, f"not YAML: {why}, expected `key: value`; check indentation and quotes")
        except yaml.YAMLError as error:  # characters that no YAML file may contain
            self._refuse(None, f"not YAML: {' '.join(str(error).split())}")
        return None

    def _refuse_tricks(self, text: str) -> None:
        """Refuses aliases, tags and deep nesting by the event stream: nothing is built yet."""
        depth = 0
        for event in yaml.parse(text, Loader=yaml.BaseLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            line = event.start_mark.line if event.start_mark else None
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                self._refuse(line, "anchors and aliases (& and *) are not read, expected each value written out")
            tag = getattr(event, "tag", None)
            if tag:
                self._refuse(line, f"the tag {tag} is not read, expected plain values")
            if depth > MAX_DEPTH:
                self._refuse(line, f"nested deeper than {MAX_DEPTH}, expected sections of a recipe")

    def _build(self, node: yaml.Node, path: Location) -> Any:
        """Plain Python data from a node; notes the line of every key."""
        self.lines.setdefault(path, node.start_mark.line + 1)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self._build(item, (*path, index)) for index, item in enumerate(node.value)]
        return _scalar(node)

    def _mapping(self, node: yaml.MappingNode, path: Location) -> dict[str, Any]:
        """A dict from a mapping node; keys that are no words or come twice are problems."""
        values: dict[str, Any] = {}
        for name, value in node.value:
            line = name.start_mark.line + 1
            inner = (*path, str(name.value) if isinstance(name, yaml.ScalarNode) else "?")
            first, self.lines[inner] = self.lines.get(inner, line), line
            if not isinstance(name, yaml.ScalarNode):
                self.blame(inner, "the key is no word, expected `name: value`")
            elif name.value in values:
                self.blame(inner, f"given twice, first at line {first}, expected once; remove one")
            else:
                values[name.value] = self._build(value, inner)
        return values


def dotted(path: Location) -> str:
    """`label.eps_place`, `scene.width[0]`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".")


def _text(path: Path) -> str:
    """The file's text, or a RecipeError that says why there is none."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path}: not UTF-8 text (byte {error.start}), expected a YAML recipe") from error
    except IsADirectoryError as error:
        raise RecipeError(f"{path}: a folder, expected a YAML recipe such as recipes/quickstart.yaml") from error
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        why = getattr(error, "strerror", None) or error
        raise RecipeError(f"{path}: cannot be read ({why}), expected a YAML recipe; `dapdata init` writes one") from error
    if len(data) > MAX_BYTES:
        raise RecipeError(f"{path}: has more than {MAX_BYTES} bytes, expected a recipe")
    if not text.strip():
        raise RecipeError(f"{path}: empty, expected a recipe; `dapdata init` writes one")
    return text


def _scalar(node: yaml.Node) -> Any:
    """A number, boolean, null or text by YAML 1.2's core schema; quoted means text."""
    value = str(node.value)
    if getattr(node, "style", None) is not None:
        return value
    if value.lower() in WORDS:
        return WORDS[value.lower()]
    if INTEGER.fullmatch(value):
        return int(value)
    return float(value) if NUMBER.fullmatch(value) else value
