"""A dataset reader: photographs beside NumPy's file of their camera poses."""

import json

import numpy as np
from pydantic import Field

from drgs.config.section import Section
from drgs.core.errors import UserError
from drgs.datasets.reader import READERS, DatasetReader, Photographs, TransformsFrame


class NumpyPosesSection(Section):
    """The section ``numpy_poses``."""

    unit: float = Field(1.0, gt=0, description="Scene units of a unit in poses.npy.")


@READERS.register("numpy_poses", section=NumpyPosesSection)
class NumpyPoses(DatasetReader):
    """Reads poses.npy (V, 4, 4), camera to world in OpenCV axes, intrinsics.json and images/."""

    def __init__(self, section: NumpyPosesSection) -> None:
        self.unit = section.unit

    def recognizes(self, folder):
        """Return whether the poses are there."""
        return (folder / "poses.npy").exists()

    def photographs(self, config):
        """Return a frame for each photograph, in the order of their names."""
        source = config.path / "poses.npy"
        poses = np.load(source, allow_pickle=False)
        poses[:, :3, 3] *= self.unit
        camera = json.loads((config.path / "intrinsics.json").read_text())
        images = sorted((config.path / "images").iterdir())
        if len(images) != len(poses):
            raise UserError(
                f"{source}: must have a pose for each of the {len(images)} files in images/, got "
                f"{len(poses)}"
            )
        focal, principal = (camera["fx"], camera["fy"]), (camera["cx"], camera["cy"])
        pairs = zip(images, poses, strict=True)
        frames = [
            TransformsFrame.from_camera(source, index, image, pose, focal, principal)
            for index, (image, pose) in enumerate(pairs)
        ]
        return Photographs("numpy_poses", source, frames)
