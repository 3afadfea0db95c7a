"""What the tests of the Python module share: pixels, and a reference in float64 that shares no code with the library."""
import faulthandler

import numpy as np

import dfb

faulthandler.dump_traceback_later(100, exit=True)  # says where a test hangs

WIDTH, HEIGHT = 150, 93


def pixels(rank, kind=np.uint8, opaque=False):
    """Premultiplied colours and depths of a rank: a quarter is empty, many depths are equal."""
    random = np.random.default_rng(rank + 1)
    levels = random.integers(0, 256, (HEIGHT, WIDTH, 4))
    if opaque:
        levels[..., 3] = 255
    levels[..., :3] = np.minimum(levels[..., :3], levels[..., 3:])
    depth = random.integers(0, 64, (HEIGHT, WIDTH)).astype(np.float32) / 64
    empty = random.integers(0, 4, (HEIGHT, WIDTH)) == 0
    levels[empty] = 0
    depth[empty] = np.inf
    rgba = levels.astype(np.uint8) if kind == np.uint8 else (levels / 255).astype(np.float32)
    return rgba, depth


def values(rgba):
    """As the library takes them."""
    return (rgba / np.float32(255) if rgba.dtype == np.uint8 else rgba).astype(np.float64)


def _over(layers, background):
    result = np.zeros(layers[0].shape)
    for layer in [*layers, np.broadcast_to(np.float32(background).astype(np.float64), result.shape)]:
        result += (1 - result[..., 3:]) * layer
    return result


def blended(images, depths, background=(0, 0, 0, 0)):
    """Front to back by depth; of equal depths the lower rank is in front. Returns colour and depth."""
    order = np.argsort(np.stack(depths), axis=0, kind="stable")
    layers = np.take_along_axis(np.stack([values(i) for i in images]), order[..., None], axis=0)
    there = [np.where(values(i)[..., 3] > 0, d, np.inf) for i, d in zip(images, depths)]
    return _over(list(layers), background), np.min(there, axis=0)


def nearest(images, depths, background=(0, 0, 0, 0)):
    """The one with the least depth; of equal ones the lowest rank's."""
    first = np.argmin(np.stack(depths), axis=0)
    layer = np.take_along_axis(np.stack([values(i) for i in images]), first[None, ..., None], axis=0)[0]
    depth = np.min(depths, axis=0)
    return _over([np.where(np.isinf(depth)[..., None], 0, layer)], background), depth


def in_order(images, places, background=(0, 0, 0, 0)):
    return _over([values(images[rank]) for rank in np.argsort(places)], background)


def assert_exact(image, expected):
    """That an image is the exact result: within half a level, or within one unit in the last place of a float."""
    assert image is not None and image.shape == expected.shape, (image, expected.shape)
    if image.dtype == np.uint8:
        off = np.abs(image - 255 * np.clip(expected, 0, 1)) - 0.5
        assert off.max() < 1e-9, f"off by {off.max() + 0.5} levels at {np.argwhere(off == off.max())[0]}"
    else:
        assert image.dtype == np.float32, image.dtype
        with np.errstate(invalid="ignore"):
            off = np.abs(image - expected) / np.spacing(np.abs(expected).astype(np.float32))
        off = np.where((image == expected) | (np.abs(image - expected) < 1e-30), 0, off)
        assert off.max() <= 1, f"off by {off.max()} ulp at {np.argwhere(off == off.max())[0]}"


def error_of(call):
    """The dfb.Error that the call raises."""
    try:
        call()
    except dfb.Error as error:
        return error
    raise AssertionError("no dfb.Error was raised")
