# SPDX-License-Identifier: BSD-3-Clause
"""Files: one format per module, all in one registry. :func:`read_scene` and :func:`write_scene` choose the format."""

from groma.io.archive import read_archive, write_archive
from groma.io.atomic import atomic_output
from groma.io.bal import read_bal, write_bal
from groma.io.colmap.model import from_pycolmap, read_colmap, to_pycolmap, write_colmap
from groma.io.depth_maps import DepthMaps
from groma.io.exports.dxf import write_dxf
from groma.io.exports.gltf import write_gltf
from groma.io.exports.recording import write_recording
from groma.io.g2o import read_g2o, write_g2o
from groma.io.interchange.bundler import read_bundler
from groma.io.interchange.meshroom import read_meshroom
from groma.io.interchange.metashape import read_metashape
from groma.io.interchange.nvm import read_nvm
from groma.io.interchange.openmvg import read_openmvg
from groma.io.interchange.opensfm import OpenSfmReconstruction, read_opensfm, read_opensfm_reconstructions
from groma.io.interchange.splats import read_splats
from groma.io.interchange.transforms import Transforms, read_transforms, write_transforms
from groma.io.limap.structures import Structures, structures_of
from groma.io.ply import write_geometry, write_obj, write_ply
from groma.io.registry import SceneFormat, check_target, formats, read_scene, register_format, write_scene
from groma.io.trajectories import Trajectory, read_trajectory, read_tum, write_trajectory, write_tum

__all__ = [
    "DepthMaps",
    "OpenSfmReconstruction",
    "SceneFormat",
    "Structures",
    "Trajectory",
    "Transforms",
    "atomic_output",
    "check_target",
    "formats",
    "from_pycolmap",
    "read_archive",
    "read_bal",
    "read_bundler",
    "read_colmap",
    "read_g2o",
    "read_meshroom",
    "read_metashape",
    "read_nvm",
    "read_openmvg",
    "read_opensfm",
    "read_opensfm_reconstructions",
    "read_scene",
    "read_splats",
    "read_trajectory",
    "read_transforms",
    "read_tum",
    "register_format",
    "structures_of",
    "to_pycolmap",
    "write_archive",
    "write_bal",
    "write_colmap",
    "write_dxf",
    "write_g2o",
    "write_geometry",
    "write_gltf",
    "write_obj",
    "write_ply",
    "write_recording",
    "write_scene",
    "write_trajectory",
    "write_transforms",
    "write_tum",
]
