"""Any source of pictures by what a user writes: a camera's number, an address, a video or a folder."""

from functools import partial
from pathlib import Path

from swarmtwin.deploy.camera.camera import Camera
from swarmtwin.deploy.camera.mjpeg_stream import MjpegStream
from swarmtwin.deploy.camera.picture_folder import PictureFolder, is_picture
from swarmtwin.deploy.camera.usb_camera import UsbCamera, video_device
from swarmtwin.deploy.camera.video_file import VideoFile
from swarmtwin.errors import UserError


def open_camera(source: str | int) -> Camera:
    """Open a source of pictures.

    Args:
        source: the number of a camera of this machine (or /dev/video2), http://... of an MJPEG stream, a video file, a
            folder of pictures or a single picture.

    Raises:
        UserError: there is no such source, or it gives no pictures.
    """
    words = str(source).strip()
    if words.isascii() and words.isdigit():
        return UsbCamera(partial(video_device, int(words)), f"camera {words} of this machine")
    if words.startswith("/dev/video"):
        return UsbCamera(partial(video_device, words), f"camera {words} of this machine")
    if words.startswith(("http://", "https://")):
        return MjpegStream(words)
    if "://" in words:
        raise UserError(
            f"camera={words}: this kind of stream cannot be read: give the camera's MJPEG address, http://..."
        )
    path = Path(words)
    if not words or not path.exists():
        raise UserError(
            f"camera={words}: there is no such file or folder: give a camera's number, an address http://..., a video "
            "or a folder of pictures"
        )
    if path.is_dir() or (is_picture(path) and path.is_file()):
        return PictureFolder(path)
    if not path.is_file():
        raise UserError(f"camera={words} is no regular file: give a video or a folder of pictures")
    return VideoFile(path)
