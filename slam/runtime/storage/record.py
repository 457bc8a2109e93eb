"""Records kept as JSON: every value is there, or the reason why it is missing; a damaged file is one clear error."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Never, Self, TypeVar, Union, get_args

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationError, model_validator
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_wrap_validator_function

from erfsfm.common.config_tree import first_problem
from erfsfm.common.files import read_text
from slam.runtime.errors import RunError

NOT_RECORDED = "not recorded"
_MAX_BYTES = 64 * 2**20
_T = TypeVar("_T")


@dataclass(frozen=True)
class Missing:
    """A value that is not known, and why; so are all its parts."""

    reason: str = NOT_RECORDED

    def __getattr__(self, name: str) -> Missing:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __iter__(self) -> Iterator[Never]:
        return iter(())


class _OrMissing:
    """Validates a value as what it is beside `Missing`, so that errors name its key alone."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        kinds = tuple(kind for kind in get_args(source) if kind is not Missing)
        schema = handler.generate_schema(Union[kinds])  # noqa: UP007 - of a tuple
        return no_info_wrap_validator_function(lambda value, check: _checked(value, check), schema)


def _checked(value: Any, check: Any) -> Any:
    return value if isinstance(value, Missing) else check(value)


Known = Annotated[_T | Missing, _OrMissing()]
Count = Annotated[int, Field(ge=0)]
MISSING = Missing()


def known(value: _T | Missing) -> _T | None:
    """The value; None where it is missing."""
    return None if isinstance(value, Missing) else value


class Record(BaseModel):
    """Part of a JSON file. A missing value is null beside ``<name>_reason``; keys without a field are not read.

    A number that is not finite is missing. JSON's own kinds are not converted.
    """

    model_config = ConfigDict(strict=True, frozen=True, populate_by_name=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _with_reasons(cls, content: Any) -> Any:
        if isinstance(content, cls):
            return content
        if not isinstance(content, dict):
            raise ValueError(f"should be an object with keys, is {str(content)[:40]!r}")
        read = dict(content)
        for name, field in cls.model_fields.items():
            key = field.alias if field.alias in content else name
            value = content.get(key, 0)
            if not any(isinstance(each, _OrMissing) for each in field.metadata):
                continue
            if value is None:
                read[key] = Missing(str(content.get(f"{key}_reason") or NOT_RECORDED))
            elif isinstance(value, float) and not math.isfinite(value):
                read[key] = Missing(f"the computation gave {value}")
        return read

    @classmethod
    def missing(cls, reason: str) -> Self:
        """All values missing for one reason."""
        return cls(**dict.fromkeys(cls.model_fields, Missing(reason)))

    @classmethod
    def read(cls, path: Path) -> Self:
        """The record in a file.

        Raises:
            FileNotFoundError: there is no such file.
            RunError: damaged, too large, nested without end, or a value of another kind; one line.
        """
        try:
            content = json.loads(read_text(path, most=_MAX_BYTES), parse_constant=_refused)
            json.dumps(content, ensure_ascii=False).encode()  # half a surrogate pair cannot be printed
            return cls.model_validate(content)
        except FileNotFoundError:
            raise
        except PermissionError as error:
            raise RunError(f"{path} cannot be read: {error.strerror}: check its permissions") from error
        except ValidationError as error:
            raise RunError(f"{path} is damaged: {first_problem(error)}; run the sequence again") from error
        except RecursionError as error:
            raise RunError(f"{path} is damaged: nested without end; run the sequence again") from error
        except (OSError, ValueError) as error:
            reason = " ".join(str(getattr(error, "strerror", None) or error).split())
            raise RunError(f"{path} is damaged: {reason}; run the sequence again") from error

    def __getitem__(self, key: str) -> Any:
        """The value of a key as JSON has it, so that a record reads like the file."""
        return self.tree()[key]

    def tree(self) -> dict[str, Any]:
        """The given values as JSON has them, in the order of the fields, reasons beside the missing ones."""
        tree: dict[str, Any] = {}
        for name, field in type(self).model_fields.items():
            if name in self.model_fields_set:
                key, value = field.alias or name, getattr(self, name)
                tree[key] = _plain(value)
                if isinstance(value, Missing):
                    tree[f"{key}_reason"] = value.reason
        return tree

    def to_json(self) -> str:
        """The record as text."""
        return json.dumps(self.tree(), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Missing):
        return None
    if isinstance(value, Record):
        return value.tree()
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list) else value


def _refused(word: str) -> Never:
    raise ValueError(f"{word} is no number of JSON")
