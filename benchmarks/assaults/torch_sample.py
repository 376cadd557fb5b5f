"""Files as `torch.save` writes them, without PyTorch: a pickle in a zip archive, storages beside it."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path

import numpy as np

KINDS = {"f8": "Double", "f4": "Float", "i8": "Long", "b1": "Bool"}


class _Global:
    """Pickled as a name of a module that need not be there."""

    def __init__(self, module: str, name: str):
        self.module, self.name = module, name


class _Storage:
    def __init__(self, identity: tuple):
        self.identity = identity


class _Tensor:
    def __init__(self, rebuild: _Global, arguments: tuple):
        self.rebuild, self.arguments = rebuild, arguments


class _Writer(pickle._Pickler):
    def persistent_id(self, value):
        return value.identity if isinstance(value, _Storage) else None

    def save(self, value, save_persistent_id=True):
        if isinstance(value, _Global):
            return self.write(b"c" + f"{value.module}\n{value.name}\n".encode())
        if isinstance(value, _Tensor):
            self.save(value.rebuild)
            self.save(value.arguments)
            return self.write(b"R")
        return super().save(value, save_persistent_id)


def torch_file(
    path: Path,
    tree: dict,
    *,
    numel: int | None = None,
    shape: tuple | None = None,
    stride: tuple | None = None,
    offset: int = 0,
    key: str | None = None,
    rebuild: tuple[str, str] = ("torch._utils", "_rebuild_tensor_v2"),
    compression: int = zipfile.ZIP_STORED,
    pickle: bytes | None = None,
    pickle_name: str = "data.pkl",
) -> None:
    """Writes arrays as tensors; what else can be given is what a hostile file would say."""
    from collections import OrderedDict
    from io import BytesIO

    data: list[bytes] = []

    def tensors(value):
        if isinstance(value, dict):
            return {name: tensors(each) for name, each in value.items()}
        if not isinstance(value, np.ndarray):
            return value
        kind = _Global("torch", KINDS[value.dtype.str[1:]] + "Storage")
        name = str(len(data)) if key is None else key
        data.append(np.ascontiguousarray(value).tobytes())
        steps = tuple(step // value.itemsize for step in np.ascontiguousarray(value).strides)
        storage = _Storage(("storage", kind, name, "cpu", value.size if numel is None else numel))
        arguments = (storage, offset, shape or value.shape, stride or steps, False, OrderedDict())
        return _Tensor(_Global(*rebuild), arguments)

    stream = BytesIO()
    _Writer(stream, 2).dump(tensors(tree))
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(f"archive/{pickle_name}", stream.getvalue() if pickle is None else pickle)
        archive.writestr("archive/byteorder", "little")
        for number, content in enumerate(data):
            archive.writestr(f"archive/data/{number}", content)
        archive.writestr("archive/version", "3\n")
