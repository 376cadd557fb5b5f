"""What pyright knows of MJX: every name, of which it assumes nothing."""

from typing import Any

def __getattr__(name: str) -> Any: ...
