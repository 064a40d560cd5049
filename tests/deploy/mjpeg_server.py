"""A small server of MJPEG for tests, which can be as rude as cameras are."""

import contextlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np


def jpeg(brightness=128, size=(64, 48)):
    """A picture of one brightness, from which a test sees which it got."""
    return cv2.imencode(".jpg", np.full(size[::-1], brightness, np.uint8))[1].tobytes()


def part(content, stamp_s=None, length=True, boundary="frame"):
    fields = "Content-Type: image/jpeg\r\n"
    fields += f"Content-Length: {len(content)}\r\n" if length else ""
    fields += f"X-Timestamp: {stamp_s:.6f}\r\n" if stamp_s is not None else ""
    return f"--{boundary}\r\n{fields}\r\n".encode() + content + b"\r\n"


class MjpegServer:
    """Serves /camera as `stream(write)` says, called anew for each connection; other paths are not there."""

    def __init__(self, stream, content_type="multipart/x-mixed-replace; boundary=frame", status=200, port=0):
        self.connections = 0
        self.gone = threading.Event()
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                if self.path != "/camera":
                    self.send_error(404)
                    return
                server.connections += 1
                self.send_response(status)
                self.send_header("Content-Type", content_type)
                self.end_headers()
                with contextlib.suppress(OSError):
                    stream(self._write, server.connections)

            def _write(self, data):
                if server.gone.is_set():
                    raise OSError
                self.wfile.write(data)

            def log_message(self, *args):
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._http.daemon_threads = True
        self.port = self._http.server_port
        self.address = f"http://127.0.0.1:{self.port}/camera"
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02})

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self.gone.set()
        self._http.shutdown()
        self._thread.join()
        self._http.server_close()
