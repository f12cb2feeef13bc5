"""Read the vertices of an STL (binary or text) or OBJ mesh file. They determine the bounding box of the mesh."""

from pathlib import Path

import numpy as np

from hil.estimator.arrays import Array

MOST_BYTES = 200_000_000
_HEADER, _TRIANGLE = 84, 50


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Find the file to which a mesh name in a URDF refers; None if it does not exist.

    Names are resolved relative to the URDF's folder and every folder above it, with or without the package name.
    """
    for scheme in ("package://", "file://"):
        if name.startswith(scheme):
            name = name[len(scheme) :]
            break
    inside = Path(*Path(name).parts[1:]) if len(Path(name).parts) > 1 else Path(name)
    for folder in (urdf.parent, *urdf.resolve().parents):
        for path in (folder / name, folder / inside):
            if path.is_file():
                return path
    return None


class UnreadMesh(ValueError):
    """Raised when a mesh cannot be used; the message says why, without naming the mesh."""


def mesh_corners(name: str, urdf: Path) -> Array:
    """Vertices (points, 3), in the file's units, of a mesh that a URDF names. Raises UnreadMesh."""
    path = find_mesh(name, urdf)
    if path is None:
        raise UnreadMesh("there is no such file in the URDF's folder or any folder above it")
    read = {".stl": _stl, ".obj": _obj}.get(path.suffix.lower())
    if read is None:
        raise UnreadMesh("only STL and OBJ files can be read; convert the file")
    try:
        is_small = path.stat().st_size <= MOST_BYTES
        found = read(path.read_bytes()) if is_small else None
    except OSError as error:
        raise UnreadMesh(f"the file cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise UnreadMesh(f"the file is damaged: {error}") from error
    if not is_small:
        raise UnreadMesh(f"the file is larger than {MOST_BYTES / 1e6:.0f} MB")
    if found is None or not len(found):
        raise UnreadMesh("the file contains no vertices")
    if not np.isfinite(found).all():
        raise UnreadMesh("the file is damaged: a vertex is not a number")
    return np.asarray(found, dtype=np.float64)


def _stl(data: bytes) -> Array | None:
    count = int.from_bytes(data[80:_HEADER], "little") if len(data) >= _HEADER else -1
    if len(data) == _HEADER + _TRIANGLE * count:
        rows = np.frombuffer(
            data, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("_", "<u2")]), offset=84
        )
        return np.asarray(rows["corners"].reshape(-1, 3), dtype=np.float64)
    lines = (line.split() for line in data.decode("ascii", "replace").splitlines())
    return _points([words[1:4] for words in lines if words[:1] == ["vertex"]])


def _obj(data: bytes) -> Array | None:
    lines = (line.split() for line in data.decode("utf-8", "replace").splitlines())
    return _points([words[1:4] for words in lines if words[:1] == ["v"]])


def _points(words: list[list[str]]) -> Array | None:
    return np.array(words, dtype=np.float64).reshape(-1, 3) if words else None
