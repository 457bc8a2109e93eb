"""Records kept as JSON: what is not known is null beside the reason; a damaged file is one clear error."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_serializer,
    model_validator,
)

from erfsfm.common.config_tree import first_problem
from erfsfm.common.files import read_text
from slam.runtime.errors import Failed, RunError

NOT_RECORDED = "not recorded"

Count = Annotated[int, Field(ge=0)]


class Record(BaseModel):
    """Part of a JSON file. A value that is not known is None, in the file null beside ``<key>_reason``.

    A part that is missing as a whole has no value, and ``absent`` says why. A number that is not
    finite is not known. JSON's own kinds are not converted, dataclasses are; keys without a field are not read.
    """

    model_config = ConfigDict(strict=True, frozen=True, populate_by_name=True, allow_inf_nan=False)

    absent: str = ""
    reasons: dict[str, str] = {}

    @model_validator(mode="before")
    @classmethod
    def _with_reasons(cls, content: Any) -> Any:
        if isinstance(content, Failed):
            return {"absent": content.reason}
        if is_dataclass(content) and not isinstance(content, type):
            content = asdict(content)
        if not isinstance(content, dict):
            if isinstance(content, cls):
                return content
            raise ValueError(f"should be an object with keys, is {str(content)[:40]!r}")
        read, reasons = dict(content), dict(content.get("reasons", {}))
        for name, field in cls.model_fields.items():
            key = field.alias if field.alias in content else name
            value = content.get(key, 0)
            if value is None and f"{key}_reason" in content:
                value = Failed(str(content[f"{key}_reason"]))
            elif value is None and _is_part(field.annotation):
                value = Failed(NOT_RECORDED)
            elif isinstance(value, float) and not math.isfinite(value):
                value = Failed(f"the computation gave {value}")
            if isinstance(value, Failed):
                read[key] = value if _is_part(field.annotation) else None
                reasons[name] = value.reason
        return read | {"reasons": reasons}

    @classmethod
    def names(cls) -> list[str]:
        """The names of all values."""
        return [name for name in cls.model_fields if name not in Record.model_fields]

    @classmethod
    def of(cls, **values: Any) -> Self:
        """With these values, each of which may be a `Failed`."""
        return cls.model_validate(values)

    @classmethod
    def unknown(cls, reason: str, *names: str) -> Self:
        """These values, or all, not known for one reason."""
        return cls.of(**dict.fromkeys(names or cls.names(), Failed(reason)))

    def why(self, name: str) -> str:
        """Why a value is not known."""
        return self.reasons.get(name) or self.absent or NOT_RECORDED

    def at(self, path: str) -> tuple[Any, str]:
        """The value at a dotted path of names or keys, and why it is not known."""
        record, absent = self, self.absent
        *parts, name = path.split(".")
        for key in parts:
            record = getattr(record, record._name(key))
            absent = absent or record.absent
        name = record._name(name)
        return getattr(record, name), absent or record.why(name)

    @classmethod
    def _name(cls, key: str) -> str:
        return next((name for name, field in cls.model_fields.items() if field.alias == key), key)

    @classmethod
    def read(cls, path: Path) -> Self:
        """The record in a file.

        Raises:
            FileNotFoundError: there is no such file.
            RunError: damaged, too large, nested without end, or a value of another kind; one line.
        """
        try:
            content = json.loads(read_text(path))
            # half a surrogate pair cannot be printed
            json.dumps(content, ensure_ascii=False).encode()
            return cls.model_validate(content)
        except FileNotFoundError:
            raise
        except PermissionError as error:
            raise RunError(
                f"{path} cannot be read: {error.strerror}: check its permissions"
            ) from error
        except (OSError, ValueError, RecursionError) as error:
            reason = first_problem(error) if isinstance(error, ValidationError) else error
            raise RunError(f"{path} is damaged: {reason}; run the sequence again") from error

    def __getitem__(self, key: str) -> Any:
        """The value of a key as JSON has it, so that a record reads like the file."""
        return self.tree()[key]

    def tree(self) -> dict[str, Any]:
        """The given values as JSON has them, in the order of the fields, reasons beside the missing ones."""
        return self.model_dump()

    @model_serializer
    def _with_reasons_beside(self) -> dict[str, Any]:
        tree: dict[str, Any] = {}
        for name in self.names():
            if name not in self.model_fields_set:
                continue
            key, value = type(self).model_fields[name].alias or name, getattr(self, name)
            absent = value.absent if isinstance(value, Record) else self.reasons.get(name, "")
            tree[key] = None if absent else value
            if absent:
                tree[f"{key}_reason"] = absent
        return tree

    def to_json(self) -> str:
        """The record as text."""
        return json.dumps(self.tree(), indent=2, allow_nan=False)


def part(kind: type[Record], alias: str | None = None) -> Any:
    """The field of a part of a record, missing by default."""
    return Field(default_factory=partial(kind, absent=NOT_RECORDED), alias=alias)


def _is_part(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Record)
