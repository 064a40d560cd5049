"""A camera's lens measured with a printed ChArUco board."""

from collections.abc import Sequence
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from swarmtwin.deploy.tracking.calibration import Lens
from swarmtwin.deploy.tracking.marker_detection import grey_of
from swarmtwin.errors import UserError
from swarmtwin.hardware import MarkerDictionary
from swarmtwin.robot import StrictModel
from swarmtwin.strict_model import Positive

Count = Annotated[int, Field(ge=3, le=100)]


class Board(StrictModel):
    """A chessboard with markers in its white squares, as OpenCV prints it.

    Attributes:
        squares: along its width and height.
        square_mm: side of a square.
        marker_mm: side of a marker.
        dictionary: of the markers.
    """

    squares: tuple[Count, Count] = (8, 6)
    square_mm: Positive = 30.0
    marker_mm: Positive = 22.0
    dictionary: MarkerDictionary = "DICT_5X5_100"

    def printed(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's board.

        Raises:
            UserError: its markers do not fit into its squares.
        """
        if self.marker_mm >= self.square_mm:
            raise UserError(f"board: markers of {self.marker_mm:g} mm do not fit into squares of {self.square_mm:g} mm")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard(self.squares, self.square_mm, self.marker_mm, dictionary)


def measure_lens(
    pictures: Sequence[np.ndarray],
    board: Board,
    fewest_pictures: int = 6,
    fewest_corners: int = 8,
    largest_error_px: float = 1.0,
) -> Lens:
    """Return a camera's lens from pictures of a board at several places and slants (Zhang, 2000).

    Tangential distortion and the third radial coefficient are taken to be 0: boards seldom determine them.

    Raises:
        UserError: too few pictures show enough of the board, they differ in size, or the board is not as stated.
    """
    printed = board.printed()
    detector = cv2.aruco.CharucoDetector(printed)
    places, pixels = [], []
    sizes = {(picture.shape[1], picture.shape[0]) for picture in pictures}
    if len(sizes) != 1:
        raise UserError("the pictures of the board differ in size: take them with one camera at one resolution")
    for picture in pictures:
        corners, numbers, _, _ = detector.detectBoard(grey_of(picture))
        if numbers is not None and len(numbers) >= fewest_corners:
            place, pixel = printed.matchImagePoints(list(corners), numbers)
            places.append(place)
            pixels.append(pixel)
    if len(places) < fewest_pictures:
        raise UserError(
            f"{len(places)} of {len(pictures)} pictures show the board well, and {fewest_pictures} are needed: hold it "
            "near and at many slants, and check board.squares and board.dictionary"
        )
    size = sizes.pop()
    fixed = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    error_px, matrix, bends, _, _ = cv2.calibrateCamera(places, pixels, size, None, None, flags=fixed)
    if error_px > largest_error_px:
        raise UserError(
            f"the board's corners are seen {error_px:.1f} px from where they should be: is it flat, and are "
            "board.squares, square_mm and marker_mm right?"
        )
    k1, k2 = bends.ravel()[:2]
    return Lens(
        image_size=size,
        focal_px=(float(matrix[0, 0]), float(matrix[1, 1])),
        centre_px=(float(matrix[0, 2]), float(matrix[1, 2])),
        distortion=(float(k1), float(k2), 0.0, 0.0, 0.0),
    )
