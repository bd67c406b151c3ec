"""Recipe keys in words: what a key may hold, where it stands, what a wrong value was perhaps meant to be.

All of it is read from the JSON Schema of the models, so a range or unit is written once, where the key is.
Functions take the schema of one key and `root`, the whole schema, into which its `$ref` points.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import inf, isfinite, log, pi
from typing import Any

from dapdata.errors import hint, nearest
from dapdata.strict_yaml import Location, dotted

Schema = dict[str, Any]

UNIT_SLIPS = {"m": (1000.0, 100.0), "rad": (180 / pi,)}  # written in mm, cm or degrees


def at(root: Schema, path: Location) -> Schema:
    """The schema of the key at a path, with its $ref followed; {} where there is no such key.

    In a list of scenes, the path names the task after the index, as pydantic's locations do.
    """
    here = root
    for part in path:
        if isinstance(part, int):
            unit = {"unit": here["unit"]} if "unit" in here else {}
            items = here.get("prefixItems", [])
            inner = unit | (items[part] if part < len(items) else here.get("items", {}))
        else:
            task = here.get("discriminator", {}).get("mapping", {}).get(part)
            inner = {"$ref": task} if task else here.get("properties", {}).get(part, {})
        here = deref(inner, root)
    return here


def deref(schema: Schema, root: Schema) -> Schema:
    """The schema with its $ref followed; what stands beside the $ref wins."""
    if "$ref" not in schema:
        return schema
    target = root["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    return {**target, **{name: value for name, value in schema.items() if name != "$ref"}}


def walk(root: Schema, path: Location = ()) -> Iterator[tuple[Location, Schema]]:
    """Every key as (path, schema), a section before what it holds."""
    for name in at(root, path).get("properties", {}):
        inner = (*path, name)
        yield inner, at(root, inner)
        yield from walk(root, inner)


def is_section(schema: Schema) -> bool:
    """Whether the key holds keys."""
    return schema.get("type") == "object" and "properties" in schema


def sentence(schema: Schema) -> str:
    """The key's sentence, one line, without the unit at its end."""
    text = " ".join(str(schema.get("description", "")).split())
    return text.removesuffix(f" [{schema.get('unit')}]")


def allowed(schema: Schema, root: Schema) -> str:
    """What a key may hold: `0.001 to 0.2 m`, `one of slic, voxel`, `a list of 2, each 0 to 1 m`."""
    schema = deref(schema, root)
    if "const" in schema:
        return str(schema["const"])
    if "enum" in schema:
        return f"one of {', '.join(str(option) for option in schema['enum'])}"
    if "anyOf" in schema:
        unit = {"unit": schema["unit"]} if "unit" in schema else {}
        return " or ".join(allowed(unit | option, root) for option in schema["anyOf"])
    if "discriminator" in schema:
        return f"a section with `task:` one of {', '.join(schema['discriminator']['mapping'])}"
    if is_section(schema):
        return f"a section with {', '.join(schema['properties'])}"
    if schema.get("type") == "array":
        return _allowed_list(schema, root)
    if schema.get("type") in ("integer", "number"):
        return _allowed_number(schema)
    words = {"boolean": "true or false", "null": "null", "string": "text"}
    pattern = f" matching {schema['pattern']}" if "pattern" in schema else ""
    return words.get(str(schema.get("type")), "a value") + pattern


def _allowed_list(schema: Schema, root: Schema) -> str:
    """`a list of 2, each 0 to 1 m`."""
    unit = {"unit": schema["unit"]} if "unit" in schema else {}
    items = schema.get("prefixItems", [schema.get("items", {})])
    inner = list(dict.fromkeys(allowed(unit | deref(item, root), root) for item in items))
    low, high = schema.get("minItems"), schema.get("maxItems")
    count = f" of {low}" if low is not None and low == high else f" of at least {low}" if low else ""
    return f"a list{count}, {'each ' if len(inner) == 1 else ''}{' and '.join(inner)}"


def _allowed_number(schema: Schema) -> str:
    """`0.001 to 0.2 m`, `a whole number, at least 1`."""
    whole = schema["type"] == "integer"
    unit = f" {schema['unit']}" if schema.get("unit") else ""
    low, high = schema.get("minimum"), schema.get("maximum")
    if low is not None and high is not None:
        return f"{'a whole number, ' if whole else ''}{low} to {high}{unit}"
    names = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    limits = [f"{word} {schema[name]}{unit}" for name, word in names.items() if name in schema]
    word = "a whole number" if whole else "a number"
    return f"{word}, {' and '.join(limits)}" if limits else f"{word}{f' in{unit}' if unit else ''}"


def shown(value: Any) -> str:
    """A value as it would stand in YAML, cut to a readable length."""
    if isinstance(value, dict):
        return "a section"
    text = "nothing" if value is None else repr(value) if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def meant(value: Any, schema: Schema) -> str:
    """`; did you mean 0.03?` where a value is a near miss: millimetres for metres, a misspelt option. Else ""."""
    if isinstance(value, str):
        return hint(value, [str(option) for option in schema.get("enum", [])])
    number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
    if not number or schema.get("type") not in ("integer", "number"):
        return ""
    scales = UNIT_SLIPS.get(schema.get("unit", ""), ())
    guesses = [float(f"{value / scale:.3g}") for scale in scales if _in_range(value / scale, schema)]
    default = schema.get("default")
    if isinstance(default, int | float) and default > 0:
        guesses.sort(key=lambda guess: abs(log(guess / default)) if guess > 0 else inf)
    return f"; did you mean {guesses[0]}?" if guesses else ""


def _in_range(value: float, schema: Schema) -> bool:
    """Whether a number meets the limits of its schema."""
    above = schema.get("minimum", -inf) <= value and schema.get("exclusiveMinimum", -inf) < value
    return bool(above and value <= schema.get("maximum", inf) and value < schema.get("exclusiveMaximum", inf))


def known_name(path: Location, root: Schema) -> str:
    """A hint for an unknown key: the same name in another section, or the nearest name beside it."""
    elsewhere = [dotted(other) for other, _ in walk(root) if other[-1] == path[-1]]
    if elsewhere:
        return f"did you mean '{elsewhere[0]}'?"
    return nearest(str(path[-1]), list(at(root, path[:-1]).get("properties", {})))
