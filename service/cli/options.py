"""What commands share: options, settings, and output files.

Most options are made from the fields of the requests: name, type, limits, default and help text. A command names the
fields that it offers and passes their values on as they are. A new field therefore needs no further declaration:
`workers.contract.requests` describes it.

This file imports no numerical libraries, so that commands start fast.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, wraps
from importlib.util import find_spec
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import annotated_types
import click
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from psfcore.errors import DataError, missing_extra
from psfcore.files import fits_in
from psfcore.noise import NoiseFigures
from service.cli.progress import echo
from service.client.outputs import base_name, check_output_folder, check_outputs, written
from workers.contract.requests import METHOD_MODELS, METHODS, Deconvolve, DefaultMethod, Option

if TYPE_CHECKING:
    from psfcore.fits.blocks import FitsLimits
    from service.client.answers import Product
    from workers.settings import Settings

Command = TypeVar("Command", bound=Callable[..., object])
_NULL = re.compile(r"; null: (.*?)(?=\. |$)")
_QUOTED = re.compile(r"`([^`]*)`")
_FALSE = re.compile(r"; false: .*$")


# --- options of the fields of a request -----------------------------------------------------------------


def options_of(model: type[BaseModel], *names: str) -> Callable[[Command], Command]:
    """The options of these fields of a request. "method", "steps" and other parameters of a method are known too.

    A command gets the values by the names of the fields. None: not given, so that the service uses its default.
    """

    def with_options(command: Command) -> Command:
        for name in reversed(names):
            command = _option(model, name)(command)
        return command

    return with_options


def methods_help() -> str:
    """When to use which method, for the end of a help text."""
    rows = (
        f"  {name:<33}{(METHOD_MODELS[name].__doc__ or '').split('. ')[0].rstrip('.')}" for name in METHODS
    )
    return "\b\nMethods:\n" + "\n".join(rows)


def _field(model: type[BaseModel], name: str) -> FieldInfo:
    return model.model_fields.get(name) or DefaultMethod.model_fields[name]


def _option(model: type[BaseModel], name: str) -> Callable[[Command], Command]:
    if name == "method":
        return click.option(
            "--method",
            type=click.Choice(METHODS),
            metavar="NAME",
            default=METHODS[0],
            help="Method; `heliopsf deconvolve -h` says which for what",
        )
    field = _field(model, name)
    kind, about, text = _kind(field), _about(field), _help(model, field)
    names = (_name(model, name), name)
    if kind is bool:
        switch = f"{names[0]}/--no-{names[0][2:]}" if field.default else names[0]
        return click.option(
            switch, name, is_flag=True, default=bool(field.default), show_default=False, help=text
        )
    if kind is NoiseFigures:
        return click.option("--noise", nargs=2, type=float, metavar="GAIN READ", help=text)
    # The default of a parameter of a method depends on the method.
    default = None if name in DefaultMethod.model_fields else field.default
    return click.option(
        *names,
        type=_type(kind, field) if about.check is None else Text(about.check, keep=True),
        metavar=about.metavar,
        default=default,
        show_default=bool(default),
        help=text,
    )


def _about(field: FieldInfo) -> Option:
    return next((one for one in field.metadata if isinstance(one, Option)), Option())


def _name(model: type[BaseModel], name: str) -> str:
    """The name of the option of a field."""
    return _about(_field(model, name)).name or f"--{name.replace('_', '-')}"


def option_name(field: str) -> str:
    """The name of the option of this field of a request for a deconvolution, or of another request."""
    return _name(Deconvolve, field) if field in Deconvolve.model_fields else f"--{field.replace('_', '-')}"


def _kind(field: FieldInfo) -> object:
    """The type of a value that is given."""
    kind = field.annotation
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (one for one in get_args(kind) if one is not NoneType)
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _type(kind: object, field: FieldInfo) -> click.ParamType:
    if get_origin(kind) is Literal:
        return click.Choice([str(one) for one in get_args(kind)])
    if kind not in (int, float):
        return click.STRING
    limits: dict[str, Any] = {}
    for one in field.metadata:
        match one:
            case annotated_types.Ge():
                limits["min"] = one.ge
            case annotated_types.Gt():
                limits |= {"min": one.gt, "min_open": True}
            case annotated_types.Le():
                limits["max"] = one.le
            case annotated_types.Lt():
                limits |= {"max": one.lt, "max_open": True}
    return click.IntRange(**limits) if kind is int else click.FloatRange(**limits)


class Text(click.ParamType):
    """The type of an option whose text a function reads. A ``DataError`` or ValueError of the function becomes a usage
    error.

    The value of the option is what the function returns; with ``keep`` it is the text.
    """

    def __init__(self, read: Callable[[str], object], *, name: str = "text", keep: bool = False) -> None:
        self.read, self.name, self.keep = read, name, keep

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> object:
        """The value of a text."""
        try:
            read = self.read(str(value))
        except ValueError as error:
            self.fail(error.message if isinstance(error, DataError) else str(error), param, ctx)
        return value if self.keep else read


def _help(model: type[BaseModel], field: FieldInfo) -> str:
    """The description of the field with the names of options; what null means is the default."""
    fields = model.model_fields.keys() | DefaultMethod.model_fields.keys()
    text = _FALSE.sub("", field.description or "")
    begins_with_value = text.startswith("`")
    text = _QUOTED.sub(lambda word: _name(model, word[1]) if word[1] in fields else word[1], text)
    default = _NULL.search(text)
    if default is not None:
        text = f"{_NULL.sub('', text, count=1)} [default: {default[1]}]"
    return text if begins_with_value else text[:1].upper() + text[1:]


# --- options that commands share ------------------------------------------------------------------------


class _Output(click.Path):
    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> str | bytes | os.PathLike[str]:
        """The path. "-" is refused: it means standard output in many programs, but commands write messages there."""
        if str(value) == "-":
            message = (
                "expected a name; got '-': results are not written to standard output. './-' is a file of this "
                "name"
            )
            self.fail(message, param, ctx)
        return super().convert(value, param, ctx)


class OutputFile(_Output):
    """The type of an option that names a file to write. ``writes_files`` checks the files of these options."""


class DrawnFile(OutputFile):
    """The type of an option that names a picture or page to write. A missing package is told before the work begins."""

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> str | bytes | os.PathLike[str]:
        """The path. Raises MissingExtra."""
        for package in ("matplotlib", "jinja2"):
            if find_spec(package) is None:
                raise missing_extra(ModuleNotFoundError(name=package))
        return super().convert(value, param, ctx)


class OutputFolder(_Output):
    """The type of an option that names a folder to write to."""


class OutputPlace(OutputFile):
    """The type of an option that names a file to write, or a folder in which the command chooses the file name."""

    def convert(  # type: ignore[override]  # more than a path
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> OutputPath:
        """The path, and whether it is a folder: a folder of this name exists, or the text ends in a slash."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        return OutputPath(path, is_folder=str(value).endswith(("/", os.sep)) or path.is_dir())


@dataclass(frozen=True)
class OutputPath:
    """Where to write a result."""

    path: Path
    is_folder: bool

    def file(self, name: str) -> Path:
        """The path of the file: this path, or the file ``name`` in it if it is a folder. The folder is made if needed.

        The service may have chosen the name, so the file is always in the folder.
        """
        if not self.is_folder:
            return self.path
        self.path.mkdir(parents=True, exist_ok=True)
        return self.path / (base_name(name) or "result.fits")


FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
OUTPUT = OutputFile(dir_okay=False, path_type=Path)
DRAWN = DrawnFile(dir_okay=False, path_type=Path)
OUTPUT_PLACE = OutputPlace()
OUTPUT_FOLDER = OutputFolder(file_okay=False, path_type=Path)
NOISE = click.option(
    "--noise",
    nargs=2,
    type=float,
    metavar="GAIN READ",
    help="Photon gain (DN per photon) and read noise (DN rms) of the camera",
)
SATURATION = options_of(Deconvolve, "saturation_dn")
CENTRE = click.option(
    "--centre",
    "centre_xy",
    nargs=2,
    type=float,
    metavar="X Y",
    help="Position of the flare, px [default: searched in IMAGE]",
)
BACKGROUND = "Image of the same frame before the flare (FITS)"
SEED = click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, help="Seed of random numbers")
JSON = click.option("--json", "json_file", type=OUTPUT, help="Write all numbers to this file (JSON)")
PLOT = click.option("--plot", type=DRAWN, help="Write a plot to this file (PNG)")
DATA = click.option(
    "--data",
    type=OUTPUT_FOLDER,
    help="Data folder [default: HELIOPSF_DATA_DIR, else the data folder of the user]",
)
OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace output files that exist")

LOCAL = "heliopsf.local"


def kept(name: str) -> Callable[..., Callable[[Command], Command]]:
    """An option whose value goes to the context of the command, under this name, and not to the command."""
    return partial(
        click.option,
        expose_value=False,
        callback=lambda context, _, value: context.meta.update({name: value}),
    )


def is_local() -> bool:
    """Whether the command has the option ``--local``."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(LOCAL))


def say_warnings(product: Product) -> None:
    """Print the warnings of a product to standard error."""
    for warning in product["details"]["warnings"]:
        echo(f"warning: {warning['message']}", err=True)


def writes_files(command: Command) -> Command:
    """Give a command the option ``--overwrite``, and check its output files before it runs.

    The outputs are the values of the options of type ``OUTPUT``. The inputs are the values of the other options and
    arguments that name files. The command gets ``overwrite`` and passes it to the code that writes.
    """

    @OVERWRITE
    @wraps(command)
    def checked(**given: object) -> object:
        _check_files(click.get_current_context().command.params, given)
        return command(**given)

    return checked  # type: ignore[return-value]  # wraps keeps the signature


def _check_files(parameters: Sequence[click.Parameter], given: dict[str, Any]) -> None:
    """Check that a command can write its files, and that it reads none of them. Raises ``ServiceError``."""
    outputs: list[Path | None] = []
    inputs: list[Path] = []
    for parameter in parameters:
        value = given.get(parameter.name or "")
        if isinstance(value, OutputPath) and value.is_folder:
            check_output_folder(value.path)
        elif isinstance(parameter.type, OutputFile):
            outputs.append(value.path if isinstance(value, OutputPath) else value)
        elif not isinstance(parameter.type, OutputFolder):
            values = value if isinstance(value, tuple) else (value,)
            inputs += [one for one in values if isinstance(one, Path)]
            if "FILE" in (parameter.metavar or ""):  # such as ID|FILE
                inputs += [Path(one) for one in values if isinstance(one, str) and Path(one).is_file()]
    check_outputs(outputs, inputs=inputs, overwrite=given["overwrite"])


def check_fresh_folder(folder: Path, inputs: Sequence[Path] = (), *, overwrite: bool = False) -> None:
    """Raise ``ClickException`` if an output folder cannot be made or written, if it holds files and ``overwrite`` is
    false, or if it holds an input.
    """
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise click.ClickException(f"{folder} is not empty; name another folder, or use --overwrite")
    for path in inputs:
        if path.resolve().is_relative_to(folder.resolve()):
            raise click.ClickException(
                f"cannot write to {folder}: it holds the input {path}; name another folder"
            )
    parent = folder.resolve().parent
    if not parent.is_dir():
        raise click.ClickException(f"cannot write {folder}: there is no folder {parent}")
    check_output_folder(folder)


def write_json(path: Path | None, content: Mapping[str, object], *, overwrite: bool = False) -> None:
    """Write ``content`` as ``write_file`` does."""
    if path is not None:
        text = json.dumps(content, indent=1, allow_nan=False) + "\n"
        write_file(path, lambda file: file.write_text(text, "utf-8"), overwrite=overwrite)


def write_file(path: Path | None, write: Callable[[Path], object], *, overwrite: bool = False) -> None:
    """Write to ``path``, if a path is given. Raises ``ServiceError`` if the file cannot be written."""
    if path is not None:
        with written(path, overwrite=overwrite) as partial:
            write(partial)


def fits_files(paths: Sequence[Path]) -> list[Path]:
    """The named files, each once. A folder is replaced by the FITS files in it, sorted by name."""
    return list(
        dict.fromkeys(file for path in paths for file in (fits_in(path) if path.is_dir() else [path]))
    )


def counted(number: int, what: str) -> str:
    """A number of things, such as "1 image" or "2 images"."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def listed(words: Sequence[str]) -> str:
    """Words as a list in a sentence: "a", "a and b", "a, b and c"."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last


def read_settings(data: Path | None = None) -> Settings:
    """The operator's settings; ``data`` replaces the data folder. Raises ``ClickException`` for wrong values."""
    from workers.settings import Settings

    try:
        return Settings() if data is None else Settings(data_dir=data)
    except ValidationError as error:
        faults = (
            f"HELIOPSF_{str(e['loc'][0]).upper()}: {e['msg']}; got {e['input']!r}" for e in error.errors()
        )
        raise click.ClickException("; ".join(faults)) from error


def psf_limits() -> FitsLimits:
    """The limits on PSF files that a command reads, from HELIOPSF_MAX_PSF_PIXELS."""
    return read_settings().psf_limits


def limits() -> FitsLimits:
    """The limits on FITS files that a command reads, from HELIOPSF_MAX_PIXELS."""
    return read_settings().image_limits
