"""What depth cameras do to a perfect depth image: presets `none`, `d415` (active stereo) and `kinect` (structured light).

Each pixel's result is a pure function of the clean image, the seed and the pixel: random numbers come from hashing
(seed, pixel, draw), so that no order of evaluation matters. With z the true depth (m), theta the angle of incidence,
f a focal length (px), b the baseline (m):

`none`: the image as it is, and believed camera poses are exact.

`d415`, in this order:
1. dropped at grazing incidence with probability 1 / (1 + exp((76 deg - theta) / 3 deg)), and anywhere with 1 %;
2. stereo shadow: pixel u of a row is hidden from the right imager, and dropped, when some u' > u has
   u' - d(u') < u - d(u) - 0.5 with the disparity d = f b / z in pixels of the rendered image;
3. edges: where the depth steps by more than 3 cm off the local plane, half of the pixels are dropped and 15 % fly,
   that is, land between the two surfaces;
4. disparity: d' = round((d + N(0, 0.09 px)) / q) q with q = 1/32 px and f of the sensor's own image, z' = f b / d'.
   So sigma_z = z^2 / (f b) sigma_d: 2.4 mm at 1 m.
   Sources: Khoshelham and Elberink, Sensors 2012, for the law; Intel's white papers on D400 tuning and subpixel
   linearity for b = 55 mm, a horizontal field of view of 65 degrees, a subpixel noise under 0.1 px, 1/32 px steps.
   The shares in 1-3 are plausible, not calibrated.

`kinect` (first generation):
1. lateral: z is read at a pixel moved by N(0, sigma_L) along both axes, sigma_L = 0.8 + 0.035 theta / (90 deg - theta) px
   of a 640x480 image with f = 585 px, scaled to the rendered one;
2. axial: z' = z + N(0, sigma_z), sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 m, and beyond 60 degrees
   + 0.0001 / sqrt(z) theta^2 / (90 deg - theta)^2 m, at most 3 cm; angles in radians;
3. dropped from 80 to 90 degrees, beyond what was measured, with probability rising from 0 to 1.
   Source: Nguyen, Izadi and Lovell, 3DIMPVT 2012.

Both have a camera-pose error of 2 mm and 0.3 degrees (std along and about each camera axis), a usual size for a
calibrated set-up. Per-pixel noise averages out in a voxel, this does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from dapdata.observe.raycast import Image
from dapdata.records import Array


@dataclass(frozen=True)
class Preset:
    """A depth camera: which kernel, and how well its pose is known."""

    kernel: int  # 0 none, 1 d415, 2 kinect
    camera_translation: float  # m, std along each axis
    camera_rotation_deg: float  # deg, std about each axis


PRESETS = {"none": Preset(0, 0.0, 0.0), "d415": Preset(1, 0.002, 0.3), "kinect": Preset(2, 0.002, 0.3)}

STEREO_BASELINE = 0.055  # m
STEREO_FOCAL = 848 / 2 / np.tan(np.radians(65.0) / 2)  # px, of the sensor's own 848x480 image
DISPARITY_NOISE = 0.09  # px
DISPARITY_STEP = 1 / 32  # px
EDGE_STEP = 0.03  # m
EDGE_DROP, EDGE_FLY = 0.5, 0.15  # shares of the edge pixels
RANDOM_DROP = 0.01  # share of all pixels
GRAZING, GRAZING_WIDTH = np.radians(76.0), np.radians(3.0)
NEVER_GRAZING = np.cos(GRAZING - 12 * GRAZING_WIDTH)  # cosine of incidence above which the share dropped is under 1e-5
RARELY_GRAZING, RARELY = np.cos(GRAZING - 5 * GRAZING_WIDTH), 0.01  # and one above which it is under this
LOG_2, SQRT_HALF_BITS = np.log(2), np.int64(np.sqrt(0.5).view(np.int64))
KINECT_FOCAL = 585.0  # px
KINECT_MAX_SIGMA = 0.03  # m
KINECT_STEEP, KINECT_LIMIT = np.radians(60.0), np.radians(80.0)


def add_noise(image: Image, K: Array, preset: str, seed: int) -> Array:
    """(H, W) f4 depth, m, as the preset's camera reports it; 0 where it reports nothing."""
    kernel = PRESETS[preset].kernel
    if kernel == 0:
        return image.depth.copy()
    out = np.zeros_like(image.depth)
    shadow = stereo_shadow(image.depth, K[0, 0] * STEREO_BASELINE) if kernel == 1 else np.zeros((1, 1), np.bool_)
    perturb(image.depth, image.facing, shadow, K[0, 0], kernel, np.uint64(seed), np.arange(len(out)), out)
    return out


@njit(cache=True)
def perturb(depth: Array, facing: Array, shadow: Array, focal: float, kernel: int, seed: Any, rows: Array, out: Array) -> None:
    """Fill the given rows, in any order, of out (H, W), zeros; focal is in px, seed a uint64."""
    width = depth.shape[1]
    is_special, noise = np.zeros(width, np.bool_), np.zeros(width)
    for v in rows:
        if kernel == 1:
            _d415(depth, facing, shadow, v, seed, is_special, noise, out)
        else:
            for u in range(width):
                if depth[v, u] > 0:
                    out[v, u] = _kinect(depth, u, v, facing[v, u], focal, _mix(seed, np.uint64(v * width + u)))


@njit(cache=True)
def stereo_shadow(depth: Array, focal_baseline: float) -> Array:
    """(H, W) bool: pixels that the right imager cannot see; focal_baseline is f b in px of this image times m."""
    height, width = depth.shape
    hidden = np.zeros((height, width), np.bool_)
    for v in range(height):
        leftmost = np.inf  # column in the right image of what was met so far, going left
        for u in range(width - 1, -1, -1):
            if depth[v, u] > 0:
                column = u - focal_baseline / depth[v, u]
                hidden[v, u] = leftmost < column - 0.5
                leftmost = min(leftmost, column)
    return hidden


@njit(cache=True, error_model="numpy")
def _d415(depth: Array, facing: Array, shadow: Array, v: int, seed: Any, is_special: Array, noise: Array, out: Array) -> None:
    """Fill row v of out with the reported depth, m; is_special and noise are (W,) to work in.

    What all pixels need goes in loops without branches, counted from 0, so that the compiler works on several pixels at a
    time. Special are the few that lie at edges or may be lost to grazing incidence.
    """
    height, width = depth.shape
    row, above, below = depth[v], depth[max(v - 1, 0)], depth[min(v + 1, height - 1)]
    for u in range(width):
        is_special[u] = (0 < v < height - 1) & _is_step(above[u], row[u], below[u])
    before, here, behind, within = row[:-2], row[1:-1], row[2:], is_special[1:-1]
    for u in range(width - 2):
        within[u] |= _is_step(before[u], here[u], behind[u])
    left, right = _span(row)
    row, cosine, hidden, special = depth[v, left:right], facing[v, left:right], shadow[v, left:right], is_special[left:right]
    reported, disparity_noise = out[v, left:right], noise[left:right]
    for u in range(len(row)):
        luck = _mix(seed, np.uint64(v * width + left + u))
        disparity_noise[u] = DISPARITY_NOISE * _normal(luck, 4)
        is_seen = (row[u] > 0) & (not hidden[u]) & (_uniform(luck, 0) >= RANDOM_DROP)
        reported[u] = _in_disparity_steps(row[u], disparity_noise[u]) if is_seen else 0.0
        special[u] |= (cosine[u] < RARELY_GRAZING) | ((cosine[u] < NEVER_GRAZING) & (_uniform(luck, 1) < RARELY))
    for u in range(left, right):
        if is_special[u] and out[v, u] > 0:
            z, luck = float(depth[v, u]), _mix(seed, np.uint64(v * width + u))
            across, fate = _across_edge(depth, u, v), _uniform(luck, 2)
            if _is_lost_grazing(facing[v, u], luck) or (across > 0 and fate < EDGE_DROP):
                out[v, u] = 0
            elif across > 0 and fate < EDGE_DROP + EDGE_FLY:
                out[v, u] = _in_disparity_steps(z + (across - z) * _uniform(luck, 3), noise[u])


@njit(cache=True, error_model="numpy")
def _in_disparity_steps(z: float, noise: float) -> float:
    """The depth of the whole number of disparity steps next to that of a depth, m, and noise, px."""
    steps = (STEREO_FOCAL * STEREO_BASELINE / z + noise) / DISPARITY_STEP
    return float(STEREO_FOCAL * STEREO_BASELINE / (max(np.rint(steps), 1.0) * DISPARITY_STEP))


@njit(cache=True)
def _span(row: Array) -> tuple[int, int]:
    """First pixel of a row that has a depth, and the one after the last."""
    left, right = 0, len(row)
    while left < right and row[left] == 0:
        left += 1
    while left < right and row[right - 1] == 0:
        right -= 1
    return left, right


@njit(cache=True)
def _is_lost_grazing(facing: float, luck: Any) -> bool:
    """Whether grazing incidence, of which `facing` is the cosine, makes a pixel report nothing."""
    if facing >= NEVER_GRAZING:
        return False
    theta = np.arccos(max(facing, 0.0))
    return bool(_uniform(luck, 1) * (1.0 + np.exp((GRAZING - theta) / GRAZING_WIDTH)) < 1.0)


@njit(cache=True)
def _kinect(depth: Array, u: int, v: int, facing: float, focal: float, luck: Any) -> float:
    """Reported depth of one pixel, m; 0 for none. facing is the cosine of the incidence, luck the pixel's random key."""
    height, width = depth.shape
    theta = np.arccos(min(max(facing, 0.0), 1.0))
    if _uniform(luck, 0) < (theta - KINECT_LIMIT) / (np.pi / 2 - KINECT_LIMIT):
        return 0.0
    off = max(np.pi / 2 - theta, 1e-3)
    lateral = (0.8 + 0.035 * theta / off) * focal / KINECT_FOCAL
    u_read = int(np.rint(u + lateral * _normal(luck, 2)))
    v_read = int(np.rint(v + lateral * _normal(luck, 4)))
    if not (0 <= u_read < width and 0 <= v_read < height) or depth[v_read, u_read] <= 0:
        return 0.0
    z = float(depth[v_read, u_read])
    axial = 0.0012 + 0.0019 * (z - 0.4) ** 2
    if theta > KINECT_STEEP:
        axial += 0.0001 / np.sqrt(z) * (theta / off) ** 2
    return float(max(z + min(axial, KINECT_MAX_SIGMA) * _normal(luck, 6), 0.0))


@njit(cache=True)
def _across_edge(depth: Array, u: int, v: int) -> float:
    """Depth on the other side of a depth edge at this pixel, or 0 where the neighbours lie on one plane with it.

    On a plane 1 / z is linear in the pixel, so its second difference vanishes at any slant.
    """
    height, width = depth.shape
    z = float(depth[v, u])
    far_side, farthest = 0.0, 0.0
    for du, dv in ((1, 0), (0, 1)):
        if not (du <= u < width - du and dv <= v < height - dv):
            continue
        a, b = float(depth[v - dv, u - du]), float(depth[v + dv, u + du])
        if _is_step(a, z, b):
            other = a if abs(a - z) > abs(b - z) else b
            if abs(other - z) > farthest:
                far_side, farthest = other, abs(other - z)
    return far_side


@njit(cache=True)
def _is_step(before: float, here: float, behind: float) -> bool:
    """Whether three depths in a row are too far from a plane: z^2 |2 / z - 1 / a - 1 / b| > EDGE_STEP without dividing."""
    a, z, b = float(before), float(here), float(behind)
    return (a > 0) & (b > 0) & (abs(2 * a * b - z * (a + b)) * z > EDGE_STEP * a * b)


@njit(cache=True)
def _mix(key: Any, word: Any) -> Any:
    """A random uint64 from two: splitmix64's output function on key + word times the golden ratio."""
    x = key + (word + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True)
def _uniform(luck: Any, draw: int) -> float:
    """Uniform in (0, 1), the draw-th of a pixel."""
    return (float(_mix(luck, np.uint64(draw)) >> np.uint64(11)) + 0.5) * 2.0**-53


@njit(cache=True, error_model="numpy", inline="always")
def _normal(luck: Any, draw: int) -> float:
    """Standard normal (Box and Muller) from a pixel's draws `draw` and `draw + 1`."""
    return float(np.sqrt(-2.0 * _log(_uniform(luck, draw))) * _cos_of_turns(_uniform(luck, draw + 1)))


# The two below are exact to 1e-15. Calls to the mathematical library would keep the compiler from working on several pixels
# at a time: they make the normals of an image 2.6 times slower.


@njit(cache=True, error_model="numpy")
def _log(x: float) -> float:
    """Natural logarithm of a positive number: x is m 2^e with m next to 1, log m = 2 artanh((m - 1) / (m + 1)), a series."""
    bits: Any = np.float64(x).view(np.int64) - SQRT_HALF_BITS
    m = np.int64((bits & 0xFFFFFFFFFFFFF) + SQRT_HALF_BITS).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    tail = 1 / 11 + z * (1 / 13 + z * (1 / 15 + z * (1 / 17 + z * (1 / 19))))
    return float((bits >> 52) * LOG_2 + 2 * (s + s * z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z * (1 / 9 + z * tail))))))


@njit(cache=True, error_model="numpy")
def _cos_of_turns(turns: float) -> float:
    """Cosine of 0 to 1 whole turns: the sine of what they are from a quarter or three, by its series."""
    x = 2 * np.pi * (abs(turns - 0.5) - 0.25)
    z = x * x
    tail = 1 - z * (1 / 110) * (1 - z * (1 / 156) * (1 - z * (1 / 210) * (1 - z * (1 / 272) * (1 - z * (1 / 342)))))
    return x * (1 - z * (1 / 6) * (1 - z * (1 / 20) * (1 - z * (1 / 42) * (1 - z * (1 / 72) * tail))))
