"""Frozen dataclasses from a YAML file, with the line and the key of whatever is wrong with it."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml

from depthba.documents import check_yaml
from depthba.errors import DepthbaError, OptionError

OPTIONS_OF = "options_of"
"""In the metadata of a field: a function from the value of the field ``kind`` to the dataclass that
this field's value must fit."""


def read_marked(path: Path, kind: Any) -> Any:
    """Return the file's content as the dataclass `kind`.

    A list becomes a tuple, a whole number a float, a text a Path (from the file's folder on where
    it is relative), and a mapping a dataclass or, for the hint Mapping, a dictionary. A missing
    `options` mapping counts as an empty one.

    Raises:
        OptionError: begins with ``FILE:LINE: KEY:`` and says what was expected.
        OSError: the file cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
        check_yaml(text)
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except UnicodeDecodeError:
        raise OptionError(f"{path}: is no text, expected YAML") from None
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f":{error.problem_mark.line + 1}"
        raise OptionError(f"{path}{line}: not YAML: {error.problem or error}") from None
    except yaml.YAMLError as error:
        raise OptionError(f"{path}: not YAML: {error}") from None
    if root is None:
        raise OptionError(f"{path}: is empty, expected {_expected(kind)}")
    return _Reader(path).converted(root, kind, "")


class _Misfit(Exception):
    """A value that does not fit its hint."""


class _Reader:
    """Converts the nodes of one file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def fail(self, node: yaml.Node, key: str, what: str) -> OptionError:
        where = f"{self._path}:{node.start_mark.line + 1}"
        return OptionError(f"{where}: {key}: {what}" if key else f"{where}: {what}")

    def converted(self, node: yaml.Node, hint: Any, key: str) -> Any:
        """The node's value as its type hint wants it; OptionError where it does not fit."""
        try:
            return self._fitted(node, hint, key)
        except _Misfit:
            raise self.fail(node, key, f"is {_shown(node)}, expected {_expected(hint)}") from None

    def _fitted(self, node: yaml.Node, hint: Any, key: str) -> Any:
        origin, arguments = typing.get_origin(hint), typing.get_args(hint)
        if origin is typing.Annotated:
            return self._fitted(node, arguments[0], key)
        if origin in (typing.Union, types.UnionType):
            return self._one_of(node, arguments, key)
        if dataclasses.is_dataclass(hint):
            return self._dataclass(node, hint, key)
        if origin is tuple:
            return self._tuple(node, arguments, key)
        if isinstance(node, yaml.ScalarNode):
            return _scalar(_plain(node), hint, self._path.parent)
        if (
            hint is Any
            or origin in (dict, Mapping)
            or origin is typing.get_origin(Mapping[str, Any])
        ):
            if hint is not Any and not isinstance(node, yaml.MappingNode):
                raise _Misfit
            return _plain(node)
        raise _Misfit

    def _one_of(self, node: yaml.Node, choices: tuple[Any, ...], key: str) -> Any:
        # A mapping that is meant for a dataclass is judged by it alone: its faults are told then.
        if isinstance(node, yaml.MappingNode):
            fitting = [choice for choice in choices if dataclasses.is_dataclass(choice)]
            if len(fitting) == 1:
                return self._fitted(node, fitting[0], key)
        for choice in choices:
            try:
                return self.converted(node, choice, key)
            except OptionError:
                continue
        raise _Misfit

    def _dataclass(self, node: yaml.Node, kind: Any, key: str) -> Any:
        if not isinstance(node, yaml.MappingNode):
            raise _Misfit
        hints = typing.get_type_hints(kind, include_extras=True)
        fields = {field.name: field for field in dataclasses.fields(kind) if field.init}
        nodes = self._entries(node, key, fields)
        values: dict[str, Any] = {}
        for name, field in fields.items():
            inner = f"{key}.{name}" if key else name
            hint = hints[name]
            if (find := field.metadata.get(OPTIONS_OF)) is not None:
                hint = self._found(find, nodes.get("kind", node), f"{key}.kind", values.get("kind"))
                if name not in nodes:
                    nodes[name] = yaml.MappingNode(
                        "tag:yaml.org,2002:map", [], node.start_mark, node.end_mark
                    )
            if name in nodes:
                values[name] = self.converted(nodes[name], hint, inner)
            elif (
                field.default is dataclasses.MISSING
                and field.default_factory is dataclasses.MISSING
            ):
                raise self.fail(node, inner, f"is missing, expected {_expected(hint)}")
        try:
            return kind(**values)
        except DepthbaError as error:
            raise self.fail(node, key, str(error)) from None

    def _found(self, find: Callable[[Any], Any], node: yaml.Node, key: str, value: Any) -> Any:
        try:
            return find(value)
        except DepthbaError as error:
            raise self.fail(node, key, str(error)) from None

    def _entries(self, node: yaml.MappingNode, key: str, known: Mapping[str, Any]) -> dict:
        nodes: dict[str, yaml.Node] = {}
        for key_node, value_node in node.value:
            name = str(key_node.value)
            inner = f"{key}.{name}" if key else name
            if name not in known:
                choices = ", ".join(known) or "none"
                raise self.fail(key_node, inner, f"unknown key, choose from: {choices}")
            if name in nodes:
                raise self.fail(key_node, inner, "is there twice, expected each key once")
            nodes[name] = value_node
        return nodes

    def _tuple(self, node: yaml.Node, arguments: tuple[Any, ...], key: str) -> tuple[Any, ...]:
        if not isinstance(node, yaml.SequenceNode):
            raise _Misfit
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            arguments = (arguments[0],) * len(node.value)
        if len(node.value) != len(arguments):
            raise _Misfit
        return tuple(
            self.converted(child, hint, f"{key}[{row}]")
            for row, (child, hint) in enumerate(zip(node.value, arguments, strict=True))
        )


def _plain(node: yaml.Node) -> Any:
    """The node's value without its marks; text that reads as a number such as 1e-3 is left text."""
    loader = yaml.SafeLoader("")
    try:
        return loader.construct_document(node)
    except (yaml.YAMLError, ValueError, OverflowError, TypeError, KeyError) as error:
        # beside what is no YAML: dates that do not exist, merges of what cannot be merged
        raise _Misfit from error
    finally:
        loader.dispose()


def _scalar(value: Any, hint: Any, folder: Path) -> Any:
    if typing.get_origin(hint) is Literal:
        if value in typing.get_args(hint):
            return value
        raise _Misfit
    if hint is Any:
        return value
    if hint is float:
        return _number(value)
    if hint is Path and isinstance(value, str):
        try:
            return (folder / Path(value).expanduser()).resolve()
        except (ValueError, RuntimeError, OSError):  # no name of a file; a home of nobody
            raise _Misfit from None
    if hint in (None, type(None)) and value is None:
        return None
    wrong = isinstance(value, bool) and hint is not bool
    if isinstance(hint, type) and isinstance(value, hint) and not wrong:
        return value
    raise _Misfit


def _number(value: Any) -> float:
    """YAML 1.1 takes 1e-3 for text: a number needs a point there, and a sign."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise _Misfit
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise _Misfit from None
    if not math.isfinite(number):
        raise _Misfit
    return number


def _shown(node: yaml.Node) -> str:
    if isinstance(node, yaml.MappingNode):
        return "a mapping"
    if isinstance(node, yaml.SequenceNode):
        return f"a list of {len(node.value)}"
    if len(node.value) > 80:
        return f"{node.value[:77]!r}…"
    return repr(node.value) if node.value else "empty"


def _expected(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return str(arguments[1])
    if dataclasses.is_dataclass(hint):
        return f"a mapping of: {', '.join(f.name for f in dataclasses.fields(hint) if f.init)}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_expected(choice) for choice in arguments if choice is not type(None))
    if origin is Literal:
        return f"one of: {', '.join(str(choice) for choice in arguments)}"
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"a list, each {_expected(arguments[0])}"
        return f"a list of {len(arguments)}, each {_expected(arguments[0])}"
    if origin is not None:
        return "a mapping"
    words = {
        float: "a finite number",
        int: "a whole number",
        bool: "true or false",
        str: "text",
        Path: "a path",
        type(None): "nothing",
    }
    return words.get(hint, str(hint))
