# SPDX-License-Identifier: Apache-2.0
"""Parameters as data: type, default, unit, range and meaning of every value in one place.

A law declares its parameters as a frozen dataclass whose fields come from :func:`parameter`; nested
dataclasses give dotted names (``hysteresis.weights``). The same declaration serves the node (ROS
descriptors), the YAML files (the layout of ROS parameter files), the engine and the command lines.
"""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
import itertools
import math
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import yaml

from piezo_control.files import replaced

T = TypeVar("T")

OF_EVERY_NODE = {"autostart", "use_sim_time", "start_type_description_service", "qos_overrides"}
"""Parameters that a dump of a running node has, and that are not the node's own."""


class ParameterError(ValueError):
    """A parameter value that cannot be used; the message names it, its value and what is allowed."""


def parameter(
    default: Any,
    description: str,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare one parameter as a dataclass field.

    Allowed types are bool, int, float, str, ``tuple[float, ...]`` and ``tuple[str, ...]``. `low` and
    `high` are inclusive and hold for every element of an array; `choices` lists the allowed strings.
    """
    metadata = {
        "description": description,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": choices,
    }
    return dataclasses.field(default=default, metadata=metadata)


def group(cls: type[T]) -> T:
    """Declare a nested parameter dataclass; its fields get the dotted name ``field.name``."""
    return dataclasses.field(default_factory=cls)


def declarations(cls: type) -> dict[str, tuple[type, dataclasses.Field]]:
    """Return ``{dotted name: (type, field)}`` of a parameter dataclass, nested ones included."""
    hints = get_type_hints(cls)
    flat: dict[str, tuple[type, dataclasses.Field]] = {}
    for field in dataclasses.fields(cls):
        if dataclasses.is_dataclass(hints[field.name]):
            for name, entry in declarations(hints[field.name]).items():
                flat[f"{field.name}.{name}"] = entry
        else:
            flat[field.name] = (hints[field.name], field)
    return flat


def flatten(parameters: Any) -> dict[str, Any]:
    """Return ``{dotted name: value}`` of a parameter dataclass instance."""
    flat: dict[str, Any] = {}
    for field in dataclasses.fields(parameters):
        value = getattr(parameters, field.name)
        if dataclasses.is_dataclass(value):
            flat.update({f"{field.name}.{name}": v for name, v in flatten(value).items()})
        else:
            flat[field.name] = value
    return flat


def build(cls: type[T], values: Mapping[str, Any], source: str = "") -> T:
    """Build `cls` from ``{dotted name: value}``; what is not named keeps its default.

    A whole number stands for a float, too.

    Raises ParameterError, prefixed by `source` (a file or node name), for an unknown name, a wrong
    type, a value out of range, and whatever the dataclass' own ``__post_init__`` refuses.
    """
    known = declarations(cls)
    try:
        for name in values:
            if name not in known:
                raise ParameterError(unknown(name, known))
        values = {name: _promoted(value, known[name][0]) for name, value in values.items()}
        for name, value in values.items():
            check(name, value, *known[name])
        return _build(cls, values)
    except ParameterError as error:
        raise ParameterError(f"{source}: {error}" if source else str(error)) from None


def _promoted(value: Any, kind: type) -> Any:
    """Return `value` with whole numbers as floats where `kind` asks for floats."""
    if kind is float and type(value) is int:
        return float(value)
    if kind == tuple[float, ...] and isinstance(value, (tuple, list)):
        return tuple(float(entry) if type(entry) is int else entry for entry in value)
    return value


def unknown(name: str, known: Iterable[str]) -> str:
    """Say that there is no parameter `name`, and which one may be meant."""
    names = list(known)
    # Of a nested name people know the last part.
    alike = [n for n in names if n.split(".")[-1] == name]
    alike = alike or difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean '{alike[0]}'?" if alike else f"known: {', '.join(names)}"
    return f"unknown parameter '{name}'; {hint}"


def _build(cls: type[T], values: Mapping[str, Any]) -> T:
    hints = get_type_hints(cls)
    arguments: dict[str, Any] = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        if dataclasses.is_dataclass(hints[field.name]):
            prefix = f"{field.name}."
            nested = {n[len(prefix) :]: v for n, v in values.items() if n.startswith(prefix)}
            try:
                arguments[field.name] = _build(hints[field.name], nested)
            except ParameterError as error:
                raise ParameterError(f"{prefix}{error}") from None
        elif field.name in values:
            value = values[field.name]
            is_array = hints[field.name] not in (bool, int, float, str)
            arguments[field.name] = tuple(value) if is_array else value
    return cls(**arguments)


def check(name: str, value: Any, kind: type, field: dataclasses.Field) -> None:
    """Raise ParameterError unless `value` has the declared type and lies in the declared range."""
    meta = field.metadata
    if kind in (bool, int, float, str):
        if type(value) is not kind:
            raise ParameterError(f"'{name}' is {value!r}, must be of type {kind.__name__}")
        elements: tuple = (value,)
    else:
        element = str if kind == tuple[str, ...] else float
        elements = tuple(value) if not isinstance(value, str) else (None,)
        for index, entry in enumerate(elements):
            if not isinstance(entry, element):
                raise ParameterError(f"'{name}[{index}]' is {entry!r}, must be {element.__name__}")
    for index, entry in enumerate(elements):
        label = name if len(elements) == 1 else f"{name}[{index}]"
        if meta["choices"] and entry not in meta["choices"]:
            raise ParameterError(f"'{label}' is {entry!r}, must be one of {list(meta['choices'])}")
        if isinstance(entry, (int, float)) and not isinstance(entry, bool):
            if not meta["low"] <= entry <= meta["high"] or math.isinf(entry):
                unit = f" {meta['unit']}" if meta["unit"] else ""
                raise ParameterError(
                    f"'{label}' is {entry!r}, must be in [{meta['low']:g}, {meta['high']:g}]{unit}"
                )


class RosLoader(yaml.SafeLoader):
    """Reads YAML as ROS 2 does: `1e-4` is a number, too, which YAML 1.1 takes for a word."""


RosLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def load(path: str | Path, node: str) -> dict[str, Any]:
    """Return ``{dotted name: value}`` that a ROS parameter file gives to the node called `node`.

    Names match by their last part, as a tool has no namespace: an exact one, ``/finger/name`` as `ros2 param
    dump` writes it, ``/**`` for every node; later matches win.

    Raises ParameterError naming the file when it cannot be read, is no parameter file or has nothing for
    `node`.
    """
    values: dict[str, Any] = {}
    sections = _sections(path)
    matching = [
        n for n in sections if fnmatch.fnmatchcase(node, n.split("/")[-1].replace("**", "*"))
    ]
    if not matching:
        raise ParameterError(f"{path}: nothing for node '{node}'; it has {list(sections)}")
    for name in matching:
        values.update(_dotted(sections[name]))
    return {n: value for n, value in values.items() if n.split(".")[0] not in OF_EVERY_NODE}


def is_for(path: str | Path, node: str) -> bool:
    """Say whether a ROS parameter file has something for a node with its namespace, as in ``/finger/feedback``.

    Names match as ROS 2 matches them: ``*`` stands for one part of a name, ``**`` for any number of parts. Raises
    ParameterError for a file that cannot be read.
    """
    parts = {"*": r"/\w+", "**": r"(/\w+)*"}
    expressions = (
        "".join(parts.get(p, "/" + re.escape(p)) for p in pattern.split("/")[1:])
        for pattern in _sections(path)
    )
    return any(re.fullmatch(expression, node) for expression in expressions)


def need_one_for(path: str | Path, nodes: Collection[str]) -> None:
    """Raise ParameterError for a ROS parameter file that has nothing for any of the `nodes`."""
    if not any(is_for(path, node) for node in nodes):
        raise ParameterError(
            f"{path}: nothing for node {' or '.join(map(repr, nodes))}; it has {list(_sections(path))} ('/**/NAME' "
            "is node NAME in any namespace)"
        )


def provenance(path: str | Path) -> list[str]:
    """Return what the head of a parameter file says of where its values come from; empty: nothing.

    Where it begins with a name, as `identify` writes one in front of each line of a block, that is the first line of
    each block; of any other head the first line of all. Raises ParameterError for a file that cannot be read.
    """
    try:
        lines = Path(path).read_text().splitlines()
    except (OSError, ValueError) as error:
        raise ParameterError(f"{path}: cannot be read: {error}") from None
    head = [line[2:] for line in itertools.takewhile(lambda line: line.startswith("# "), lines)]
    blocks: dict[str, str] = {}
    for line in head:
        if named := re.match(r"(\w+): ", line):
            blocks.setdefault(named[1], line)
        elif not blocks:
            return [line]
    return list(blocks.values())


def _sections(path: str | Path) -> dict[str, dict]:
    """Return ``{node name: parameters}`` of a ROS parameter file; nested names are joined by '/'."""
    try:
        content = yaml.load(Path(path).read_text(), RosLoader)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, yaml.YAMLError) as error:
        words = " ".join(str(error).split())  # of several lines, with the place in the text
        raise ParameterError(f"{path}: cannot be read as YAML: {words}") from None
    except RecursionError:
        raise ParameterError(f"{path}: cannot be read as YAML: nested too deeply") from None
    if not isinstance(content, dict):
        raise ParameterError(f"{path}: not a ROS parameter file: the top level is no mapping")

    def collect(tree: Mapping[Any, Any], namespace: str) -> dict[str, dict]:
        found: dict[str, dict] = {}
        for key, entry in tree.items():
            name = f"{namespace}/{str(key).strip('/')}"
            if not isinstance(entry, dict):
                raise ParameterError(f"{path}: '{name}' has no 'ros__parameters' mapping")
            own = entry.get("ros__parameters")
            found.update({name: own} if isinstance(own, dict) else collect(entry, name))
        return found

    return collect(content, "")


def _dotted(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat.update(_dotted(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def dump(path: str | Path, node: str, values: Mapping[str, Any], comment: str = "") -> None:
    """Write ``{dotted name: value}`` as a ROS parameter file for `node`.

    `comment` goes on top, each line behind a '#'. Empty arrays are left out: ROS cannot type them.
    """
    tree: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, (tuple, list)):
            if not value:
                continue
            value = list(value)
        *parents, leaf = name.split(".")
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
        branch[leaf] = value
    text = "".join(f"# {line}\n" for line in comment.splitlines())
    content = {f"/**/{node}": {"ros__parameters": tree}}
    text += yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
    with replaced(Path(path)) as (place,):
        place.write_text(text)
