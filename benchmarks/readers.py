"""Those who look on from other machines: of a browser, what the viewer knows of it; they draw nothing.

`python -m benchmarks.readers http://127.0.0.1:8080 3` reads as three of them until it is ended.
"""

import asyncio
import sys
from importlib.metadata import version
from typing import Any

import msgpack
from websockets import Subprotocol
from websockets.asyncio.client import connect

# What a page says first, without which nobody looks as far as the viewer is concerned.
CAMERA: bytes = msgpack.packb(
    {
        "type": "ViewerCameraMessage",
        "wxyz": (1.0, 0.0, 0.0, 0.0),
        "position": (0.0, -10.0, 0.0),
        "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, 0.0, -1.0),
        "fov": 0.75,
        "near": 0.01,
        "far": 1000.0,
        "image_height": 600,
        "image_width": 900,
    }
)


def target(address: str) -> dict[str, Any]:
    """What to connect to, by a viewer's address, as its pages do."""
    return {
        "uri": address.replace("http", "ws", 1),
        "subprotocols": [Subprotocol(f"viser-v{version('viser')}")],
        "max_size": None,
    }


async def _read(address: str) -> None:
    async with connect(**target(address)) as connection:
        await connection.send(CAMERA)
        async for _ in connection:
            pass


async def _all(address: str, count: int) -> None:
    await asyncio.gather(*(_read(address) for _ in range(count)))


if __name__ == "__main__":
    asyncio.run(_all(sys.argv[1], int(sys.argv[2])))
