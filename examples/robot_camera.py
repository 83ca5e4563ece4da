"""The camera of a robot simulator: colour, depth and labels of a scene of splats, in numpy.

``python examples/robot_camera.py [FILE]`` moves one around a scene and prints its frame rate.
"""

import drgs  # comes first: it selects the LLVM that Dr.Jit loads

# isort: split
import sys
import time

import mitsuba as mi
import numpy as np

MITSUBA_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])  # x left, y up: from OpenCV's axes, and to them


class SplatCamera:
    """A pinhole camera; labels: (N,) integers from 0, by Gaussian; fov: degrees, horizontal."""

    def __init__(self, path, labels, width=320, height=240, fov=60.0):
        one_hot = mi.TensorXf(np.eye(np.max(labels) + 1)[labels])
        splats = {"type": "splats", "filename": str(path), "srgb_primitives": False}
        splats |= {"feature_labels": one_hot, "aovs": "z:depth, a:alpha, labels:feature_labels"}
        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        sensor = {"type": "perspective", "fov": fov, "film": film}
        self.scene = mi.load_dict({"type": "scene", "integrator": splats, "sensor": sensor})
        self.sensor = mi.traverse(self.scene.sensors()[0])

    def render(self, camera_to_world):
        """Return ``rgb`` (H, W, 3) uint8, ``depth`` (H, W) float32 and ``labels`` (H, W) integers.

        camera_to_world: (4, 4), x right, y down, z forward, as in ROS's optical frames. Depth is z
        in the camera, scene units. Depth and label are 0 where alpha is below 0.5.
        """
        self.sensor["to_world"] = mi.Transform4f(camera_to_world @ MITSUBA_AXES)
        self.sensor.update()
        image = mi.render(self.scene, spp=1).numpy()
        rgb, depth, alpha, labels = np.split(image, [3, 4, 5], axis=2)
        depth = np.where(alpha < 0.5, 0, depth / np.maximum(alpha, 0.5))[:, :, 0]
        labels = np.where(depth > 0, labels.argmax(axis=2), 0)
        return {"rgb": np.uint8(255 * rgb.clip(0, 1) + 0.5), "depth": depth, "labels": labels}


def main(path=drgs.EXAMPLE, frames=60):
    """Drive around a scene whose lower and upper halves have the labels 1 and 2."""
    mi.set_variant("llvm_ad_rgb")
    means, times = drgs.Gaussians.load(path).means, []
    middle, radius = np.median(means, axis=0), 5 * means.std()
    camera = SplatCamera(path, np.where(means[:, 2] > middle[2], 2, 1))
    for angle in np.linspace(0, 4 * np.pi, 2 * frames, endpoint=False):  # the first turn: warm-up
        origin = middle + radius * np.array([np.cos(angle), np.sin(angle), 0.5])
        pose = mi.ScalarTransform4f().look_at(origin, middle, [0, 0, 1])
        camera.render(np.array(pose.matrix) @ MITSUBA_AXES)
        times.append(time.perf_counter())
    print(f"{len(means):,} Gaussians: {frames / (times[-1] - times[frames - 1]):.1f} frames/s")


if __name__ == "__main__":
    main(*sys.argv[1:])
