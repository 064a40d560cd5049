"""The live view's process: a page with the overhead picture, how each vehicle stands, and the red button."""

import asyncio
import json
import os
import socket
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from swarmtwin.deploy.child_process import say_mistake, say_ready, told_by_parent
from swarmtwin.deploy.control.heartbeat import Heartbeat
from swarmtwin.deploy.live_view.overlay import Overlay
from swarmtwin.deploy.live_view.slot import Slot
from swarmtwin.deploy.live_view.view_process import Scene
from swarmtwin.errors import UserError

BOUNDARY = b"--picture"


class View:
    """What the page is answered from: the newest of what the controller handed over."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self.scene = scene
        self.heartbeat = Heartbeat.open(folder / "heartbeat")
        self._state_slot = Slot.open(folder / "state")
        self._picture_slot = Slot.open(folder / "picture")
        self._overlay = Overlay(scene)
        self._state: dict[str, Any] = {}
        self._seen: dict[str, float] = {}
        self._jpeg: tuple[int, bytes] = (-1, b"")

    def state(self) -> dict[str, Any]:
        """Return how it stands, ages as of now."""
        self._read_state()
        now_s = time.monotonic()
        vehicles = {}
        for vehicle in self.scene.vehicles:
            about = self._state.get("vehicles", {}).get(vehicle, {})
            captured_s = max(self._seen.get(vehicle, 0.0), about.get("captured_s", 0.0))
            vehicles[vehicle] = {**about, "age_ms": 1000 * (now_s - captured_s) if captured_s else None}
        return {
            **self._state,
            "vehicles": vehicles,
            "phase": self.heartbeat.phase.name.lower(),
            "latched": self.heartbeat.latched,
            "stop_requested": bool(self.heartbeat.read("stop_requested")),
            "silent_s": now_s - self.heartbeat.read("controller_beat_s"),
        }

    def picture(self) -> bytes:
        """Return the newest picture as JPEG; drawn once, however many look."""
        self._read_state()
        read = self._picture_slot.read()
        number, content = read if read else (0, b"")
        if number == self._jpeg[0] and number:
            return self._jpeg[1]
        image, poses, age_s = None, {}, 0.0
        if content:
            length = int.from_bytes(content[:4], "little")
            about = json.loads(content[4 : 4 + length])
            image = np.frombuffer(content, np.uint8, offset=4 + length).reshape(about["shape"])
            poses, age_s = about["poses"], time.monotonic() - about["captured_s"]
            self._seen |= dict.fromkeys(poses, about["captured_s"])
        drawn = self._overlay.draw(image, poses, age_s, self._state)
        _, encoded = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 82])
        self._jpeg = (number, encoded.tobytes())
        return self._jpeg[1]

    def _read_state(self) -> None:
        if read := self._state_slot.read():
            self._state = json.loads(read[1])


def application(view: View) -> Starlette:
    """Return the web application."""
    page = Path(__file__).with_name("page.html").read_text()
    about = view.scene.model_dump(include={"title", "vehicles", "colours", "period_s"})

    async def index(request: Request) -> Response:
        return HTMLResponse(page.replace("__SCENE__", json.dumps(about).replace("<", "\\u003c")))

    async def picture(request: Request) -> Response:
        async def parts() -> AsyncIterator[bytes]:
            last = b""
            while True:
                jpeg = await asyncio.to_thread(view.picture)
                if jpeg is not last:
                    last = jpeg
                    head = b"\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
                    yield BOUNDARY + head + jpeg + b"\r\n"
                await asyncio.sleep(1 / view.scene.pictures_per_s)

        return StreamingResponse(parts(), media_type="multipart/x-mixed-replace; boundary=picture")

    async def one_picture(request: Request) -> Response:
        return Response(await asyncio.to_thread(view.picture), media_type="image/jpeg")

    async def events(request: Request) -> Response:
        async def states() -> AsyncIterator[bytes]:
            while True:
                yield b"data: " + json.dumps(view.state()).encode() + b"\n\n"
                await asyncio.sleep(0.2)

        return StreamingResponse(states(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def state(request: Request) -> Response:
        return JSONResponse(view.state())

    async def stop(request: Request) -> Response:
        view.heartbeat.write("stop_requested", 1)
        return JSONResponse({"stopping": True})

    return Starlette(
        routes=[
            Route("/", index),
            Route("/picture", picture),
            Route("/picture.jpg", one_picture),
            Route("/events", events),
            Route("/state", state),
            Route("/stop", stop, methods=["POST"]),
        ]
    )


def main() -> None:
    """Serve the page until the parent ends."""
    told = told_by_parent()
    with suppress(OSError):
        os.nice(10)  # whatever control needs comes first
    cv2.setNumThreads(1)
    scene = Scene.parse(told["scene"], "scene")
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((scene.host, scene.port))
    except OSError as error:
        say_mistake(UserError(f"the page cannot be served at {scene.host}:{scene.port}: {error.strerror}"))
        return
    listening.listen(64)  # from now on those who come wait instead of being turned away
    application_ = application(View(scene, Path(told["folder"])))
    say_ready(address=f"http://{scene.host}:{listening.getsockname()[1]}/")
    server = uvicorn.Server(uvicorn.Config(application_, log_level="error", timeout_graceful_shutdown=1))
    server.run(sockets=[listening])


if __name__ == "__main__":
    main()
