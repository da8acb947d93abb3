"""Parses a verb's words into its dataclass, with defaults from a YAML file where one is named."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
from collections.abc import Mapping, Sequence
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import docstring_parser
import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from depthba.errors import OptionError

Arguments = TypeVar("Arguments")

Known = Mapping[str, Sequence[str]]
"""By option of a verb, the words that may follow it; under "" those that are arguments."""

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
    with_config = _with_config(kind)
    path = _config_path(words)
    default = None if path is None else _with_defaults(with_config, _read(path, kind))
    parsed: Any = tyro.cli(
        with_config,
        prog=prog,
        args=list(words),
        description=inspect.cleandoc(kind.__doc__ or ""),
        default=default,
        config=_STYLE,
        registry=_FORMS,
    )
    values = {field.name: getattr(parsed, field.name) for field in dataclasses.fields(with_config)}
    del values["config"]
    return kind(**values)


def completion(
    kinds: Mapping[str, type[Any]], prog: str, shell: str, known: Mapping[str, Known]
) -> str:
    """Return the script with which a shell completes a command of several verbs.

    Args:
        kinds: by verb, the dataclass of its arguments.
        prog: the command.
        shell: bash, zsh or fish.
        known: by verb and option, words to offer that the types do not tell; under "" those for
            arguments.
    """
    told = {name: {**_positional(kind), **known.get(name, {})} for name, kind in kinds.items()}
    verbs = tuple(
        Annotated[_with_config(kind), tyro.conf.subcommand(name)] for name, kind in kinds.items()
    )
    both: Any = Union[verbs]  # noqa: UP007 (of a tuple, which has no other form)
    words = ["--tyro-print-completion", shell]
    out = io.StringIO()
    # tyro ends the process once it has printed
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        tyro.cli(both, prog=prog, args=words, config=_STYLE, registry=_FORMS)
    return _mended(out.getvalue(), shell, told)


def _positional(kind: type[Any]) -> Known:
    """Return the words that a verb's arguments choose from, under ""; nothing: it takes none."""
    hints = [
        get_args(hint)[0]
        for hint in known_keys(kind).values()
        if tyro.conf.Positional in getattr(hint, "__metadata__", ())
    ]
    choices = [str(word) for h in hints if get_origin(h) is Literal for word in get_args(h)]
    return {"": choices} if hints else {}


def _mended(script: str, shell: str, known: Mapping[str, Known]) -> str:
    """Let tyro's script offer files, and the words it does not know, where they are meant."""
    from depthba.verbs import completing

    part = f"KNOWN = {dict(known)!r}\n\n\n{inspect.getsource(completing.offered)}\n\n"
    head = "def main() -> None:"
    call = "get_completions(words, current_index, COMPLETION_SPEC)"
    ours = "offered(words, current_index, COMPLETION_SPEC, KNOWN, get_completions)"
    swaps = {head: part.replace('"', '\\"') + head if shell == "fish" else part + head, call: ours}
    if shell == "bash":
        # readline's own way with files puts a slash behind a folder and escapes blanks
        swaps['COMPREPLY=($(compgen -f -- "$cur"))'] = "COMPREPLY=()"
        swaps["complete -F "] = "complete -o default -F "
    if shell == "fish":
        # its words end before the one at the cursor
        swaps["$words $current)"] = "$words (commandline -ct) $current)"
    for old, new in swaps.items():
        script = script.replace(old, new)
    return script


def _with_config(kind: type[Any]) -> Any:
    """Return the dataclass with the option --config beside its own."""
    _joined_help(kind)
    config_type = Annotated[str | None, tyro.conf.arg(metavar="FILE", help=_CONFIG_HELP)]
    return dataclasses.make_dataclass(
        kind.__name__, [("config", config_type, None)], bases=(kind,), frozen=True
    )


def _joined_help(kind: type[Any]) -> None:
    """Give the fields of a dataclass, and of those in it, their docstrings as one line each.

    tyro keeps the line breaks of a docstring, which would fall anywhere on a line of a terminal.
    """
    told: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):
        for param in docstring_parser.parse_from_object(one).params:
            told[param.arg_name] = " ".join((param.description or "").split())
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        if group := _group(hints[field.name]):
            _joined_help(group)
        elif told.get(field.name):
            field.metadata = MappingProxyType({**field.metadata, "help": told[field.name]})


def known_keys(kind: type[Any]) -> dict[str, Any]:
    """Return the keys that a configuration file may have for a dataclass, with their types."""
    keys: dict[str, Any] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if group := _group(hint):
            keys |= known_keys(group)
        else:
            keys[name] = hint
    return keys


def _group(hint: Any) -> type[Any] | None:
    """Return the dataclass behind a hint, with or without a note on it; None: it is none."""
    bare = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    return bare if isinstance(bare, type) and dataclasses.is_dataclass(bare) else None


def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Let the help of ``X | None`` read as that of X; None can still be given as a word."""
    if get_origin(info.type) not in (Union, UnionType):
        return None
    members = [member for member in get_args(info.type) if member is not NoneType]
    if len(members) != 1 or len(get_args(info.type)) != 2:
        return None
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(members[0], info.markers))
    if isinstance(inner, UnsupportedTypeAnnotationError) or not isinstance(inner.nargs, int):
        return None

    def read(words: list[str]) -> Any:
        return None if words == ["None"] else inner.instance_from_str(words)

    return dataclasses.replace(
        inner,
        nargs=1 if inner.nargs == 1 else (inner.nargs, 1),
        choices=None if inner.choices is None else (*inner.choices, "None"),
        instance_from_str=read,
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda v: ["None"] if v is None else inner.str_from_instance(v),
    )


_FORMS = ConstructorRegistry()
_FORMS.primitive_rule(_optional)


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
        if group := _group(hint):
            filled[field.name] = _with_defaults(group, values)
        elif field.name in values:
            filled[field.name] = values[field.name]
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            filled[field.name] = tyro.MISSING
    return kind(**filled)
