"""The process in which a model file is compiled, see `files`; it imports nothing else of the package.

Arguments: the file, where the compiled model goes, and how many bytes and seconds it may take. It exits with 1, and
says why on standard output, where MuJoCo refuses the file.
"""

import sys

import mujoco


def _compile(path: str, result: str, memory: int, seconds: int) -> int:
    try:
        import resource
    except ImportError:  # Windows has no such limits.
        pass
    else:
        for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds), (resource.RLIMIT_CORE, 0)):
            hardest = resource.getrlimit(kind)[1]
            limit = limit if hardest == resource.RLIM_INFINITY else min(limit, hardest)
            resource.setrlimit(kind, (limit, limit))
    try:
        model = mujoco.MjModel.from_xml_path(path)
        # Some models compile, and have no room for their own contacts.
        mujoco.mj_forward(model, mujoco.MjData(model))
        mujoco.mj_saveModel(model, result)
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        sys.stdout.buffer.write(str(error).encode("utf-8", "replace"))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_compile(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
