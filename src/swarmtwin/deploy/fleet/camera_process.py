"""The overhead camera of a fleet as a process: pictures as MJPEG over HTTP, each with the time when it was taken."""

import asyncio
import html
import socket
import threading
import time
from collections.abc import AsyncIterator, Mapping
from typing import Any

import cv2
import uvicorn
from pydantic import Field, TypeAdapter, ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from swarmtwin.deploy.child_process import say_mistake, say_ready, told_by_parent
from swarmtwin.deploy.fleet.fleet_memory import FleetMemory
from swarmtwin.deploy.fleet.orders import CameraFaults, Orders, RobotFaults
from swarmtwin.deploy.fleet.shutter import Picture, Shutter
from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.overhead_camera import CameraConditions
from swarmtwin.strict_model import StrictModel

PAGE = """<!doctype html><meta charset="utf-8"><title>{title}</title>
<body style="font-family: sans-serif; margin: 2em"><h1>{title}</h1>
<p>{vehicles} under an emulated overhead camera: <a href="/camera">/camera</a> (MJPEG).
<p><img src="/camera" style="max-width: 100%; border: 1px solid #888">"""


class FaultsRequest(StrictModel):
    """What `POST /faults` takes: it replaces all faults that there are.

    Attributes:
        robots: by vehicle.
        camera: of the camera.
    """

    robots: Mapping[str, RobotFaults] = Field(default_factory=dict)
    camera: CameraFaults = CameraFaults()


class CameraProcess:
    """Serves `/camera`, `/` for people, and takes `POST /place` and `POST /faults`."""

    def __init__(self, told: dict[str, Any]) -> None:
        robot = Robot.parse(told["robot"], "robot")
        self._vehicles: list[str] = told["vehicles"]
        self._title = f"{len(self._vehicles)} × {robot.title}"
        self._memory = FleetMemory(self._vehicles, told["memory"])
        effects = [parse_effects(entries, robot, len(self._vehicles)) for entries in told["effects"]]
        conditions = CameraConditions.parse(told["camera"], "camera")
        self._shutter = Shutter(
            robot,
            self._vehicles,
            effects,
            conditions,
            self._memory,
            told["seed"],
            told["fps"],
            self._arrive_later,
            told["rays_per_side"],
            told["obstacles"],
        )
        self._newest: tuple[int, Picture] | None = None
        self._arrived = asyncio.Event()
        self._viewers = 0
        self._loop: asyncio.AbstractEventLoop

    async def serve(self, listening: socket.socket) -> None:
        """Serve for ever."""
        self._loop = asyncio.get_running_loop()
        threading.Thread(target=self._shutter.run, daemon=True).start()
        routes = [
            Route("/", self._page),
            Route("/camera", self._stream),
            Route("/place", self._place, methods=["POST"]),
            Route("/faults", self._set_faults, methods=["POST"]),
            Route("/state", self._state),
        ]
        config = uvicorn.Config(Starlette(routes=routes), log_level="critical", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        say_ready(port=listening.getsockname()[1], size=self._shutter.size)
        await server.serve(sockets=[listening])

    def _arrive_later(self, picture: Picture, delay_s: float) -> None:
        """Is called from the shutter's thread."""
        self._loop.call_soon_threadsafe(self._loop.call_later, delay_s, self._arrive, picture)

    def _arrive(self, picture: Picture) -> None:
        self._newest = (self._newest[0] + 1 if self._newest else 0, picture)
        self._arrived.set()
        self._arrived = asyncio.Event()

    async def _stream(self, request: Request) -> Response:
        return StreamingResponse(self._parts(), media_type="multipart/x-mixed-replace; boundary=picture")

    async def _parts(self) -> AsyncIterator[bytes]:
        """Yield pictures; whoever is slow misses some and never gets an old one."""
        last = self._newest[0] if self._newest else -1
        self._viewers += 1
        self._shutter.is_watched.set()
        try:
            while True:
                while self._newest is None or self._newest[0] == last:
                    await self._arrived.wait()
                last, picture = self._newest
                yield (
                    b"--picture\r\nContent-Type: image/jpeg\r\n"
                    b"Content-Length: %d\r\nX-Timestamp: %.6f\r\n\r\n%b\r\n"
                    % (len(picture.jpeg), picture.stamp_s, picture.jpeg)
                )
        finally:
            self._viewers -= 1
            if not self._viewers:
                self._shutter.is_watched.clear()

    async def _page(self, request: Request) -> Response:
        names = html.escape(", ".join(self._vehicles))
        return HTMLResponse(PAGE.format(title=html.escape(self._title), vehicles=names))

    async def _state(self, request: Request) -> Response:
        orders = self._memory.orders() or Orders()
        shutter = self._shutter
        return JSONResponse(
            {
                "vehicles": self._vehicles,
                "pictures": shutter.taken,
                "late_pictures": shutter.late,
                "faults": orders.model_dump(mode="json", include={"robots", "camera"}),
            }
        )

    async def _place(self, request: Request) -> Response:
        try:
            asked = TypeAdapter(dict[str, tuple[float, float, float]]).validate_json(await request.body())
        except ValidationError as error:
            return _mistake(f'write {{"1": [x_mm, y_mm, heading_rad], ...}}: {error.errors()[0]["msg"]}')
        try:
            orders = self._memory.change_orders(lambda before: before.with_placed(asked))
        except UserError as error:
            return _mistake(str(error))
        end_s = time.monotonic() + 2.0
        while not self._memory.have_placed(orders, asked):
            if time.monotonic() > end_s:
                return _mistake("not all of the vehicles are switched on", status=503)
            await asyncio.sleep(0.005)
        return JSONResponse({"placed": sorted(asked)})

    async def _set_faults(self, request: Request) -> Response:
        try:
            asked = FaultsRequest.model_validate_json(await request.body())
        except ValidationError as error:
            first = error.errors()[0]
            return _mistake(f"{'.'.join(map(str, first['loc']))}: {first['msg']}")
        try:
            self._memory.change_orders(lambda before: before.with_faults(asked.robots, asked.camera))
        except UserError as error:
            return _mistake(str(error))
        return JSONResponse({})


def _mistake(message: str, status: int = 400) -> Response:
    return JSONResponse({"mistake": message}, status)


def _listen(host: str, port: int, buffered_bytes: int = 1 << 18) -> socket.socket:
    """Return a socket that listens; few pictures wait in it for those who are slow.

    Raises:
        UserError: nobody can listen there.
    """
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, buffered_bytes)
    try:
        listening.bind((host, port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise UserError(f"camera_port={port}: {error.strerror}: give another one") from None
    return listening


def main() -> None:
    """Be a camera until the parent ends."""
    told = told_by_parent()
    cv2.setNumThreads(1)
    try:
        listening = _listen(told["host"], told["port"])
        camera = CameraProcess(told)
    except UserError as error:
        say_mistake(error)
        return
    asyncio.run(camera.serve(listening))


if __name__ == "__main__":
    main()
