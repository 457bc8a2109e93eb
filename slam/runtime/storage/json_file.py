"""JSON files that may be damaged or edited by hand: read up to a limit and checked against a model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from erfsfm.common.config_tree import first_problem
from erfsfm.common.files import read_text
from slam.runtime.errors import RunError

_MAX_BYTES = 64 * 2**20


def read_json(path: Path, model: type[BaseModel]) -> dict[str, Any]:
    """The object in a file, as written, after a check of the keys that the model names.

    Raises:
        FileNotFoundError: there is no such file.
        RunError: damaged, too large, nested without end, or a value of another kind; one line.
    """
    try:
        content = json.loads(read_text(path, "utf-8-sig", _MAX_BYTES))
        model.model_validate(content)
        json.dumps(content, ensure_ascii=False).encode()  # half a surrogate pair cannot be printed
    except FileNotFoundError:
        raise
    except PermissionError as error:
        raise RunError(f"{path} cannot be read: {error.strerror}: check its permissions") from error
    except ValidationError as error:
        raise RunError(f"{path} is damaged: {first_problem(error)}; run the sequence again") from error
    except RecursionError as error:
        raise RunError(f"{path} is damaged: nested without end; run the sequence again") from error
    except (OSError, ValueError) as error:
        raise RunError(f"{path} is damaged: {' '.join(str(error).split())}; run the sequence again") from error
    return dict(content)
