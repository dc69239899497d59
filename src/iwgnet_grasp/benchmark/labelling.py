"""How fast settled scenes become labelled samples."""

from __future__ import annotations

import time
from typing import NamedTuple

import cv2
import yaml

from iwgnet_grasp.data.generate import CONFIG, Scene, SceneMaker, encode_scene

FAMILIES = ["connecting_rod"]
SEED = 9000
PILES = 5


class LabellingRate(NamedTuple):
    per_second: float  # samples (300x300: both depths, mask, grasps) a second of one core
    samples: int
    scenes: int


class _Timed(SceneMaker):
    """Counts the processor time from a settled scene to the content of its files."""

    seconds = 0.0
    samples = 0
    scenes = 0

    def observe(self, rng) -> Scene:
        start = time.process_time()
        scene = super().observe(rng)
        files = encode_scene(scene, 0, FAMILIES)
        self.seconds += time.process_time() - start
        self.samples += sum(name.endswith("_grasps.txt") for name in files)
        self.scenes += 1
        return scene


def measure_labelling(detector: bool) -> LabellingRate:
    """detector: with the colour of the samples and of the detector's images."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    maker = _Timed(FAMILIES, yaml.safe_load(CONFIG.read_text()), detector=detector)
    for pile in range(PILES):
        for _ in maker.pile(SEED, pile):
            pass
    cv2.setNumThreads(threads)
    return LabellingRate(maker.samples / maker.seconds, maker.samples, maker.scenes)
