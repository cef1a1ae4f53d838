"""SHA-256 of what is written to disk, by which it tells when it is read whether it is still the same.

A digest finds damage and changes made by accident or by hand. It is no signature: who changes a file on purpose can
write a new one beside it.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any


def ordered_digest(content: dict[str, Any]) -> str:
    """SHA-256 of a table whose order says something too, as that of a model's variables."""
    return digest(json.dumps(content, allow_nan=False).encode())


def digest(content: Any) -> str:
    """SHA-256 of bytes, or of a table in its one canonical form: sorted keys, numbers to the last digit."""
    data = content if isinstance(content, bytes) else json.dumps(content, sort_keys=True, allow_nan=False).encode()
    return hashlib.sha256(data).hexdigest()
