"""Parses a verb's words into its dataclass, with defaults from a YAML file where one is named."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro

from depthba.errors import OptionError

Arguments = TypeVar("Arguments")

_STYLE = (
    tyro.conf.OmitArgPrefixes,  # Options stand flat beside the verb's own
    tyro.conf.FlagCreatePairsOff,  # --overwrite, without --no-overwrite beside it
)
_CONFIG_HELP = "YAML file with defaults for these arguments; the command line wins."


def parse(kind: type[Arguments], words: Sequence[str], prog: str) -> Arguments:
    """Parse words into an instance of a dataclass.

    Ends the process with status 0 after ``--help``, and with 2 where the words are wrong.

    Args:
        kind: a frozen dataclass; fields that are dataclasses themselves are laid flat.
        words: the command line after the verb.
        prog: how the command is called, for the help.

    Raises:
        OptionError: the file behind ``--config`` has an unknown key or a wrong value.
        OSError: that file cannot be read.
    """
    config_type = Annotated[str | None, tyro.conf.arg(metavar="FILE", help=_CONFIG_HELP)]
    with_config: Any = dataclasses.make_dataclass(
        kind.__name__, [("config", config_type, None)], bases=(kind,), frozen=True
    )
    path = _config_path(words)
    default = None if path is None else _with_defaults(with_config, _read(path, kind))
    parsed: Any = tyro.cli(
        with_config,
        prog=prog,
        args=list(words),
        description=inspect.cleandoc(kind.__doc__ or ""),
        default=default,
        config=_STYLE,
    )
    values = {field.name: getattr(parsed, field.name) for field in dataclasses.fields(with_config)}
    del values["config"]
    return kind(**values)


def known_keys(kind: type[Any]) -> dict[str, Any]:
    """Return the keys that a configuration file may have for a dataclass, with their types."""
    keys: dict[str, Any] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            keys |= known_keys(hint)
        else:
            keys[name] = hint
    return keys


def _config_path(words: Sequence[str]) -> str | None:
    path = None
    for index, word in enumerate(words):
        if word == "--config" and index + 1 < len(words):
            path = words[index + 1]
        elif word.startswith("--config="):
            path = word.partition("=")[2]
    return path


def _read(path: str, kind: type[Any]) -> dict[str, Any]:
    """Return the values in the file, parsed as the command line would parse them."""
    import yaml

    from depthba.documents import parse_yaml

    with open(path, encoding="utf-8") as file:
        try:
            content = parse_yaml(file.read())
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise OptionError(f"{path}: not YAML: {error}") from error
    if content is None:
        content = {}
    if not isinstance(content, dict):
        raise OptionError(f"{path}: {content!r}, expected keys and values")
    keys = known_keys(kind)
    values = {}
    for key, value in content.items():
        name = str(key).replace("-", "_")
        if name not in keys:
            choices = ", ".join(sorted(keys))
            raise OptionError(f"{path}: unknown key {key!r}; choose from: {choices}")
        values[name] = _value(path, name, value, keys[name])
    return values


def _value(path: str, name: str, value: Any, hint: Any) -> Any:
    if hint is bool and isinstance(value, bool):
        return value
    words = [str(word) for word in (value if isinstance(value, list) else [value])]
    holder: Any = dataclasses.make_dataclass("holder", [("value", hint)])
    try:
        if hint is bool or isinstance(value, dict):
            raise ValueError
        with contextlib.redirect_stderr(io.StringIO()):
            return tyro.cli(holder, args=words, config=(tyro.conf.PositionalRequiredArgs,)).value
    except (SystemExit, ValueError):
        expected = getattr(hint, "__name__", None) if isinstance(hint, type) else None
        expected = expected or str(hint).replace("typing.", "")
        raise OptionError(f"{path}: {name} is {value!r}, expected {expected}") from None


def _with_defaults(kind: type[Any], values: dict[str, Any]) -> Any:
    """Return an instance with the values filled in; what is still required is marked missing."""
    filled: dict[str, Any] = {}
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            filled[field.name] = _with_defaults(hint, values)
        elif field.name in values:
            filled[field.name] = values[field.name]
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            filled[field.name] = tyro.MISSING
    return kind(**filled)
