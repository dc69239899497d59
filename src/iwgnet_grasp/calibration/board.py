"""Calibration targets: what is printed on the plate, and where it is in an image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from iwgnet_grasp.calibration.settings import CalibrationError, Settings

NAMES = ("charuco", "apriltag")
_PIXELS_PER_MM = 10  # of the print: every edge of the configured boards falls between two pixels
_REFINE = 0.12  # half window of the corners' sub-pixel search, in sides of a square
_REFINE_PX = (2, 5)  # and its limits


class DetectionError(CalibrationError):
    """The target cannot be used in this image; says why."""


@dataclass(frozen=True)
class Detection:
    corners: np.ndarray  # (n, 3) m, board frame
    pixels: np.ndarray  # (n, 2) px; the centre of the top left pixel is (0, 0)


class Board:
    """A target of config/calibration.yaml by its name, charuco or apriltag."""

    def __init__(self, name: str, settings: Settings) -> None:
        if name not in NAMES:
            raise CalibrationError(f"board '{name}' is not one of {', '.join(NAMES)}")
        self.name = name
        self._settings = settings
        layout = settings.boards[name]
        self._dictionary = cv2.aruco.getPredefinedDictionary(
            getattr(cv2.aruco, layout["dictionary"])
        )
        self._parameters = cv2.aruco.DetectorParameters_create()
        if name == "charuco":
            columns, rows = layout["squares"]
            self._grid = cv2.aruco.CharucoBoard_create(
                columns, rows, layout["square"], layout["marker"], self._dictionary
            )
            size = np.array([columns, rows]) * layout["square"]
            points = np.asarray(self._grid.chessboardCorners)
        else:
            columns, rows = layout["tags"]
            self._grid = cv2.aruco.GridBoard_create(
                columns, rows, layout["tag"], layout["gap"], self._dictionary
            )
            size = np.array([columns, rows]) * (layout["tag"] + layout["gap"]) - layout["gap"]
            points = np.concatenate(self._grid.objPoints)
        if np.any(size > settings.print_size + 1e-9):
            raise CalibrationError(f"calibration.yaml: the {name} board is larger than its print")
        self._size = size
        # OpenCV's boards begin in their upper left corner, y down.
        self.corners = np.zeros((len(points), 3))
        self.corners[:, 0] = points[:, 0] - size[0] / 2
        self.corners[:, 1] = size[1] / 2 - points[:, 1]

    def print(self) -> np.ndarray:
        """(H, W) uint8: the albedo in 1/255 of the print."""
        scale = 1000 * _PIXELS_PER_MM
        columns, rows = np.rint(self._settings.print_size * scale).astype(int)
        width, height = np.rint(self._size * scale).astype(int)
        pattern = self._grid.draw((int(width), int(height)), None, 0, 1) > 127
        white = np.full((rows, columns), True)
        top, left = (rows - height) // 2, (columns - width) // 2
        white[top : top + height, left : left + width] = pattern
        s = self._settings
        return np.where(white, round(255 * s.white), round(255 * s.black)).astype(np.uint8)

    def detect(self, image: np.ndarray, K: np.ndarray) -> Detection:
        """The board's corners in an RGB image of a camera without distortion; K: (3, 3).

        Raises DetectionError when the board is not in view, or only a part of it.
        """
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        markers, ids, _ = cv2.aruco.detectMarkers(
            gray, self._dictionary, parameters=self._parameters
        )
        if ids is None or len(ids) == 0:
            raise DetectionError("no board in view")
        if self.name == "charuco":
            _, pixels, found = cv2.aruco.interpolateCornersCharuco(
                markers, ids, gray, self._grid, cameraMatrix=K, distCoeffs=np.zeros(5)
            )
            indices = np.zeros(0, int) if found is None else found.ravel()
            pixels = np.zeros((0, 2)) if found is None else pixels.reshape(-1, 2).astype(float)
        else:
            known = np.flatnonzero(ids.ravel() < len(self.corners) // 4)
            indices = np.concatenate([4 * ids.ravel()[i] + np.arange(4) for i in known] or [[]])
            indices = indices.astype(int)
            pixels = np.concatenate([markers[i].reshape(4, 2) for i in known] or [np.zeros((0, 2))])
            pixels = pixels.astype(float)
        least = max(6, int(np.ceil(self._settings.min_corners * len(self.corners))))
        if len(indices) < least:
            raise DetectionError(
                f"only {len(indices)} of the board's {len(self.corners)} corners are seen, "
                f"{least} needed: is it half out of the image, or hidden?"
            )
        return Detection(self.corners[indices], _refined(gray, pixels, self._side_px(markers)))

    def _side_px(self, markers: tuple[np.ndarray, ...]) -> float:
        """Shortest side of a square or tag in the image."""
        sides = [np.linalg.norm(m[0] - np.roll(m[0], 1, axis=0), axis=1).min() for m in markers]
        layout = self._settings.boards[self.name]
        ratio = layout["square"] / layout["marker"] if self.name == "charuco" else 1.0
        return float(np.median(sides)) * ratio

    def pose(self, detection: Detection, K: np.ndarray) -> tuple[np.ndarray, float]:
        """T_camera_board (4, 4) of a detection, and the RMS of its corners in px.

        Raises DetectionError when no pose puts the corners where they were seen.
        """
        corners, pixels = detection.corners, detection.pixels
        found, turns, moves, _ = cv2.solvePnPGeneric(
            corners, pixels, K, None, flags=cv2.SOLVEPNP_IPPE
        )
        best, best_rms = None, np.inf
        for turn, move in zip(turns, moves, strict=True) if found else ():
            turn, move = cv2.solvePnPRefineLM(corners, pixels, K, None, turn, move)
            predicted, _ = cv2.projectPoints(corners, turn, move, K, None)
            rms = float(np.sqrt(np.mean((predicted.reshape(-1, 2) - pixels) ** 2)))
            if rms < best_rms:
                best, best_rms = (turn, move), rms
        if best is None or best_rms > self._settings.max_rms_px:
            raise DetectionError(
                f"the corners do not lie on one board (RMS {best_rms:.1f} px); is another target "
                "in view, or the camera's calibration wrong?"
            )
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(best[0])[0]
        T[:3, 3] = best[1].ravel()
        return T, best_rms


def _refined(gray: np.ndarray, pixels: np.ndarray, side_px: float) -> np.ndarray:
    """Corners to a fraction of a pixel. Done here for both boards: what OpenCV 4.6 says of a
    ChArUco board's corners is half a pixel too far to the right and down.
    """
    half = int(np.clip(_REFINE * side_px, *_REFINE_PX))
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    return cv2.cornerSubPix(gray, start, (half, half), (-1, -1), stop).reshape(-1, 2).astype(float)
