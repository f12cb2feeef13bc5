"""The copy of an arm's file in a run folder. The copy must be readable without the files next to the original."""

from pathlib import Path

import numpy as np

from hil.description.arm import ArmFileError
from hil.description.files import is_mjcf


def kept_bytes(path: Path) -> bytes:
    """Return the bytes to store as the copy of a URDF or MJCF file. Raises OSError, ArmFileError.

    A URDF is kept unchanged. MuJoCo cannot read an MJCF whose meshes, textures or included files are missing, so an
    MJCF that needs other files is made self-contained: included files are inlined; shapes that need other files are
    removed.
    """
    if not is_mjcf(path) or not (text := _self_contained(path)):
        return path.read_bytes()
    return text.encode()


def _self_contained(path: Path) -> str:
    """The MJCF as self-contained text; "" if the file is already self-contained."""
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(path))
        model = spec.compile()
    except ValueError as error:
        raise ArmFileError(f"{path}: MuJoCo cannot read it: {error}") from error
    needs = spec.meshes or spec.textures or spec.hfields or spec.skins
    if not needs and "<include" not in path.read_text(encoding="utf-8"):
        return ""
    for body in spec.bodies[1:]:
        body.explicitinertial = True
        number = body.id
        body.mass, body.ipos, body.iquat = model.body_mass[number], model.body_ipos[number], model.body_iquat[number]
        body.inertia, body.fullinertia = model.body_inertia[number], np.full(6, np.nan)
    of_files = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
    for geom in list(spec.geoms):
        if geom.type in of_files or geom.meshname:
            spec.delete(geom)
        else:
            geom.material = ""
    for each in (*spec.skins, *spec.meshes, *spec.hfields, *spec.materials, *spec.textures):
        spec.delete(each)
    text: str = spec.to_xml()
    return text
