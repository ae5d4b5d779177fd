"""Triangles whose vertices have colours, as viser shows them in exactly these colours.

viser's own meshes have one colour, or light and shadow of its making. A glTF with KHR_materials_unlit has
neither. Its colours still go through the tone mapping of three.js (ACES, after S. Hill), which is undone
here beforehand; they are floats, because bright colours lie beyond 1.
"""

import json
import struct

import numpy as np
from numpy.typing import NDArray

_TO_FILM = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_FROM_FILM = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)
_EXPOSURE = 1 / 0.6

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963


def unlit_glb(
    vertices: NDArray[np.float32], triangles: NDArray[np.integer], colors: NDArray[np.uint8]
) -> bytes:
    """A .glb of triangles (m, 3) between vertices (n, 3) with colours (n, 3) RGB; they are seen from where
    they run counter-clockwise."""
    small = len(vertices) <= 1 << 16
    parts = (
        (vertices.astype(np.float32), "VEC3", _FLOAT, _VERTICES),
        (before_tone_mapping(colors), "VEC3", _FLOAT, _VERTICES),
        (triangles.reshape(-1).astype(np.uint16 if small else np.uint32), "SCALAR",
         _UINT16 if small else _UINT32, _INDICES),
    )  # fmt: skip
    accessors, views, data = [], [], b""
    for i, (values, kind, number, target) in enumerate(parts):
        accessors.append({"bufferView": i, "componentType": number, "count": len(values), "type": kind})
        content = values.tobytes()
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content), "target": target})
        data += content + bytes(-len(content) % 4)
    accessors[0] |= {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    scene = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    return b"".join(
        [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(data), b"BIN\0"), data]
    )


def before_tone_mapping(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The linear light (n, 3) that the tone mapping of three.js turns into colours (n, 3) in sRGB."""
    share = colors / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    film = light @ np.linalg.inv(_FROM_FILM).T
    # The curve is y = (v (v + 0.0245786) - 0.000090537) / (v (0.983729 v + 0.432951) + 0.238081).
    a = 1.0 - 0.983729 * film
    b = 0.0245786 - 0.432951 * film
    c = -0.000090537 - 0.238081 * film
    v = (np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0)) - b) / (2.0 * a)
    return (v @ np.linalg.inv(_TO_FILM).T / _EXPOSURE).astype(np.float32)
