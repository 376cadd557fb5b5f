"""Pickles that call, reach out, or ask for more than there is: what Python's own unpickler would do with them."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np


class Call:
    def __init__(self, function, *arguments):
        self.what = function, arguments

    def __reduce__(self):
        return self.what


class WithState:
    def __reduce__(self):
        return np.dtype, ("f8", False, True), {"descr": "O8"}


CANARY = "canary"
CALLS = {
    "os.system": Call(os.system, f"touch {CANARY}"),
    "eval": Call(eval, f"open('{CANARY}', 'w')"),
    "open": Call(open, CANARY, "w"),
    "getattr": Call(getattr, "x", "upper"),
    "load": Call(np.load, "x.npy"),
    "in an array": np.array([Call(os.system, f"touch {CANARY}")], object),
    "in arrays in arrays": np.array([np.array([Call(exec, f"open('{CANARY}', 'w')")], object), 1], object),
    "in a dict": {"grasp_qpos": Call(exec, f"open('{CANARY}', 'w')")},
    "another array": np.array([1.0]).view(np.matrix),
    "masked array": np.ma.array([1.0]),
    "record": np.zeros(2, [("a", "f8")]),
    "date": np.array(["2020-01-01"], "M8[D]"),
    "complex": np.zeros(2, complex),
    "path": Path("/etc/passwd"),
    "set": {1, 2},
    "bound": Call("x".upper),
    "state": WithState(),
    "encoding": Call(__import__("codecs").encode, "eval", "rot13"),
    "long": 1 << 9000,
    "key": {(1, 2): 3},
}
_CORE = b"cnumpy.core.multiarray\n_reconstruct\n"
_START = _CORE + b"(cnumpy\nndarray\n(K\x00tC\x01btR"
_TYPE = b"cnumpy\ndtype\n(X\x02\x00\x00\x00f8\x89\x88tR"
RAW = {
    "another kind": _CORE + b"(cos\nsystem\n(K\x00tC\x01btR.",
    "kind as text": _CORE + b"(X\x05\x00\x00\x00eval!(K\x00tC\x01btR.",
    "gigantic": _START + b"(K\x01(I99999999999\nt" + _TYPE + b"\x89C\x08aaaaaaaatb.",
    "negative": _START + b"(K\x01(J\xff\xff\xff\xfft" + _TYPE + b"\x89C\x08aaaaaaaatb.",
    "truth as a length": _START + b"(K\x01(\x88t" + _TYPE + b"\x89C\x08aaaaaaaatb.",
    "objects of bytes": _START + b"(K\x01(K\x01tcnumpy\ndtype\n(X\x02\x00\x00\x00O8tR\x89C\x08aaaaaaaatb.",
    "no state": _START + b".",
    "state twice": _START + b"(K\x01(K\x00t" + _TYPE + b"\x89C\x00tbNb.",
    "state of a dict": b"}}b.",
    "call of a dict": b"})R.",
    "call of an array": b"cnumpy\nndarray\n)R.",
    "circle": b"]q\x00h\x00a.",
    "circle of dicts": b"}q\x00K\x01h\x00s.",
    "deep": b"]" * 1000 + b"a" * 999 + b".",
    "deep tuples": b"N" + b"\x85" * 100_000 + b".",
    "marks": b"(" * 100_000 + b".",
    "repeats": b"]q\x00" + b"".join(b"](" + b"h%c" % k * 40 + b"eq%c" % (k + 1) for k in range(6)) + b".",
    "opcodes": b"}0" * 3_000_000 + b"N.",
    "gigantic bytes": b"\x8e" + struct.pack("<Q", 2**62) + b"x.",
    "gigantic text": b"X\xff\xff\xff\xffx.",
    "gigantic whole number": b"\x8b\xff\xff\xff\x7f1.",
    "whole number of digits": b"I" + b"9" * 5000 + b"\n.",
    "memo": b"h\x07.",
    "empty stack": b"0.",
    "instance": b"(ios\nsystem\n.",
    "object": b"(cos\nsystem\no.",
    "new": b"\x80\x02cbuiltins\nobject\n)\x81.",
    "extension": b"\x82\x01.",
    "persistent": b"X\x01\x00\x00\x00aQ.",
    "later protocol": b"\x80\x09N.",
    "name as bytes": b"C\x02osC\x06system\x93.",
    "nothing": b"",
}
