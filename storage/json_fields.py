"""Fields of dataclasses from JSON that a stranger wrote: KeyError or TypeError where they differ from what is meant."""

from __future__ import annotations

from dataclasses import fields

_JSON_TYPES: dict[str, tuple[type, ...]] = {
    "int": (int,),
    "float": (int, float),
    "str": (str,),
    "bool": (bool,),
    "dict": (dict,),
}


def typed(cls: type, data: dict, **parsed):
    """A dataclass of the `parsed` fields and, for the others, the plain values of `data`."""
    for wanted in fields(cls):
        if wanted.name not in parsed:
            parsed[wanted.name] = plain(data[wanted.name], str(wanted.type), wanted.name)
    return cls(**parsed)


def plain(value, kind: str, name: str):
    """A value of one of the _JSON_TYPES; `kind` is the field's annotation."""
    if not isinstance(value, _JSON_TYPES[kind]) or isinstance(value, bool) != (kind == "bool"):
        raise TypeError(f"{name} is {value!r}, not of type {kind}")
    return float(value) if kind == "float" else value  # type: ignore[arg-type]


def listed(value, n: int | None = None) -> list | tuple:
    """The value, a list of `n` values or of any number. Raises TypeError where it is none."""
    if not isinstance(value, (list, tuple)) or n not in (None, len(value)):
        raise TypeError(f"{value!r} is no list of {'any number of' if n is None else n} values")
    return value


def numbers(value, n: int) -> tuple[float, ...]:
    """`n` finite numbers. Raises TypeError where they are not."""
    return tuple(plain(x, "float", "a coordinate") for x in listed(value, n))


def whole_numbers(value, n: int) -> tuple[int, ...]:
    """`n` whole numbers. Raises TypeError where they are not."""
    return tuple(plain(x, "int", "a component") for x in listed(value, n))
