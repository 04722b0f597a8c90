"""The form in which values are kept on the disk and sent by the worker: cattrs reads and writes the dataclasses of the
calibration themselves, field by field, by the rules of this module.

What is read may be damaged or forged, so nothing is taken for something else: no text for a number, no number for a
flag. Numbers are finite, and an array has exactly its shape. Fields that a reader does not know are ignored; a field
that is missing takes the default of the dataclass, if there is one.
"""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from math import inf, isfinite, nan
from types import GenericAlias, UnionType
from typing import Any, TypeVar, get_args

import numpy as np
from cattrs import BaseValidationError, Converter, transform_error
from cattrs.cols import homogenous_tuple_structure_factory, is_mapping
from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn, override
from numpy.typing import NDArray

from coec.geometry import se3

T = TypeVar("T")
Hook = Callable[[Any, Any], Any]


class MalformedValueError(ValueError):
    """A value is not in the form that is written; the text says at which place, and what is expected there."""


class NotRigidError(ValueError):
    """A matrix that should be a pose is no rigid transform."""


def make_converter(*, forbid_extra_keys: bool = False) -> Converter:
    """A converter with the rules above; tuples become lists. cattrs by itself takes whatever can be iterated for a
    tuple, and whatever a number, text or object can be made of for one."""
    converter = Converter(forbid_extra_keys=forbid_extra_keys, unstruct_collection_overrides={tuple: list})
    for plain, read in ((float, number), (int, whole_number), (bool, flag)):
        converter.register_structure_hook(plain, read)
        converter.register_unstructure_hook(plain, plain)  # NumPy's numbers become those of Python
    # cattrs has the hook of `str` read every `StrEnum`, too.
    converter.register_structure_hook(str, lambda value, form: text(value) if form is str else form(value))

    def read_tuple(form: Any) -> Hook:
        if get_args(form)[-1] is Ellipsis:
            return _only(list | tuple, "a list", homogenous_tuple_structure_factory(form, converter))
        return _only(list | tuple, "a list", converter.gen_structure_hetero_tuple(form))

    converter.register_structure_hook_factory(
        lambda form: isinstance(form, GenericAlias) and form.__origin__ is tuple, read_tuple
    )
    converter.register_structure_hook_factory(
        is_mapping, lambda form: _only(Mapping, "an object", converter.gen_structure_mapping(form))
    )
    converter.register_structure_hook_factory(
        dataclasses.is_dataclass, lambda form: _only(Mapping, "an object", make_dict_structure_fn(form, converter))
    )
    return converter


def register(converter: Converter, form: type, *, required: Collection[str] = (), **fields: Any) -> None:
    """Registers the rules for fields of a dataclass; the classes of its other fields first, if they have rules. Fields
    that are `required` may not be missing although they have a default."""
    read: Hook = make_dict_structure_fn(form, converter, **fields)

    def read_complete(value: Mapping[str, Any], of: Any) -> Any:
        if missing := [name for name in required if name not in value]:
            raise MalformedValueError(f"{', '.join(missing)} is missing")
        return read(value, of)

    converter.register_structure_hook(form, _only(Mapping, "an object", read_complete))
    converter.register_unstructure_hook(form, make_dict_unstructure_fn(form, converter, **fields))


def _only(kinds: type | UnionType, expected: str, read: Hook) -> Hook:
    """`read` for values of these types; all others are refused."""

    def read_only(value: Any, form: Any) -> Any:
        if not isinstance(value, kinds):
            raise MalformedValueError(f"expected {expected}")
        return read(value, form)

    return read_only


def structured(converter: Converter, value: object, form: type[T]) -> T:
    """The value in this form.

    Raises:
        MalformedValueError: it is not in this form; says where.
    """
    try:
        return converter.structure(value, form)
    except (BaseValidationError, ValueError, TypeError) as error:
        complaints = (one.rpartition(" @ ") for one in transform_error(error, format_exception=_expected))
        lines = (f"{place.removeprefix('$').lstrip('.') or '(top)'}: {what}" for what, _, place in complaints)
        raise MalformedValueError("; ".join(lines)) from error


def number(value: Any, _: object = None) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < inf:
        raise MalformedValueError("expected a finite number")
    try:
        return float(value)
    except OverflowError:
        raise MalformedValueError("expected a finite number") from None


def whole_number(value: Any, _: object = None) -> int:
    """A whole number; one with a decimal point only where a float counts in ones."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise MalformedValueError("expected a whole number")
    return value


def text(value: Any, _: object = None) -> str:
    """A text."""
    if not isinstance(value, str):
        raise MalformedValueError("expected a text")
    return value


def flag(value: Any, _: object = None) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise MalformedValueError("expected true or false")
    return value


def bounded(read: Callable[[Any], T], accepts: Callable[[T], bool], expected: str) -> Any:
    """A field whose values are a part of a type; `expected` says which."""

    def read_bounded(value: Any, _: object) -> T:
        result = read(value)
        if not accepts(result):
            raise MalformedValueError(f"expected {expected}")
        return result

    return override(struct_hook=read_bounded)


def null_for(absent: float) -> Any:
    """A number of which JSON has no form where it is `absent`, NaN or infinite; null stands for it."""
    return override(
        struct_hook=lambda value, _: absent if value is None else number(value),
        unstruct_hook=lambda value: value if isfinite(value) else None,
    )


def array(*shape: int, null: bool = False, of: Callable[[Any], float] = number) -> Any:
    """An array of this shape as nested lists, in which null stands for NaN if `null`."""
    element = (lambda value: nan if value is None else of(value)) if null else of
    return override(
        struct_hook=lambda value, _: read_array(value, shape, element),
        unstruct_hook=_nulled if null else np.ndarray.tolist,
    )


def arrays(*shape: int) -> Any:
    """Arrays of this shape by name."""
    return override(
        struct_hook=lambda value, _: {text(name): read_array(value[name], shape, number) for name in dict(value)},
        unstruct_hook=lambda value: {name: one.tolist() for name, one in value.items()},
    )


def read_array(value: Any, shape: tuple[int, ...], element: Callable[[Any], float] = number) -> NDArray[Any]:
    """The array of this shape in nested lists; each number is read by `element`.

    Raises:
        MalformedValueError: it has another shape, or `element` refuses a number.
    """

    def read_part(part: Any, rest: tuple[int, ...]) -> Any:
        if not rest:
            return element(part)
        if not isinstance(part, list | tuple) or len(part) != rest[0]:
            raise MalformedValueError(f"expected numbers of shape {' × '.join(map(str, shape))}")
        return [read_part(one, rest[1:]) for one in part]

    return np.array(read_part(value, shape))


def read_pose(value: Any, _: object = None) -> NDArray[np.float64]:
    """The pose (4, 4) in these rows, checked to be rigid, because a checksum does not prove who wrote them.

    Raises:
        MalformedValueError: these are not 4 × 4 numbers.
        NotRigidError: they are no rigid transform.
    """
    pose = read_array(value, (4, 4))
    if not se3.is_rigid(pose):
        raise NotRigidError("is not a rigid transform: rows of a rotation, a translation, then 0 0 0 1")
    return pose


POSE = override(struct_hook=read_pose, unstruct_hook=np.ndarray.tolist)
"""A field that is a pose (4, 4)."""


def _nulled(values: NDArray[np.float64]) -> Any:
    def nulled(part: Any) -> Any:
        return [nulled(one) for one in part] if isinstance(part, list) else part if isfinite(part) else None

    return nulled(values.tolist())


def _expected(error: BaseException, form: type | None) -> str:
    """What is wrong at one place, without the value, which may be anything."""
    if isinstance(error, KeyError):
        return "is missing"
    if isinstance(error, MalformedValueError | NotRigidError):
        return str(error)
    return f"expected {getattr(form, '__name__', 'another form')}"
