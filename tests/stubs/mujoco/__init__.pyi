"""What pyright knows of MuJoCo, whose own modules carry no types: every name, of which it assumes nothing.

Its bindings are compiled, and what they are made of can be told by no reader of Python.
"""

from typing import Any

from mujoco import mjx as mjx

def __getattr__(name: str) -> Any: ...
