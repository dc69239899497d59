"""The report of many trials: docs/results.md and the page."""

import re
from dataclasses import asdict
from html.parser import HTMLParser

import numpy as np
from PIL import Image
from test_trial_statistics import pick, record

from iwgnet_grasp.report.film import Frame, looking_at, write_gif
from iwgnet_grasp.report.results_page import read_sections, write_section
from iwgnet_grasp.report.trial_report import Report, command_line, write_docs, write_page
from iwgnet_grasp.trials.statistics import summary
from iwgnet_grasp.trials.worker import Conditions

SCENES = ["five_scattered", "ten_stacked"]


def summary_of(successes, **conditions):
    """50 trials a scene, of which as many succeed."""
    records = [
        record([pick(seed < successes, "" if seed < successes else "slipped")], scene, seed)
        for scene in SCENES
        for seed in range(50)
    ]
    run = {"scenes": SCENES, "trials": 50, "first_seed": 0, **asdict(Conditions(**conditions))}
    return {"run": run, **summary(records, SCENES)}


def report():
    comparison = {
        "name": "priority",
        "title": "Order of the objects",
        "command": "scripts/run_trials compare priority",
        "variants": [
            {"name": "depth only", "settings": {"priority.beta": 0.0}, "summary": summary_of(40)},
            {"name": "both", "settings": {}, "summary": summary_of(49)},
        ],
    }
    runs = {"A look after each pick": summary_of(49), "One look": summary_of(43, replan="once")}
    return Report(runs, [comparison], [])


def test_the_command_of_a_run_repeats_it():
    run = summary_of(1, replan="once", overrides={"priority.alpha": 0.5}, camera_offset=3)["run"]
    assert command_line(run) == (
        "scripts/run_trials --scene five_scattered,ten_stacked --trials 50 --seed 0 --replan once "
        "--camera-offset 3 --set priority.alpha=0.5"
    )


def test_docs_get_their_two_sections_and_keep_the_others(tmp_path):
    page = tmp_path / "docs" / "results.md"
    write_section("learning", "## Learning\n\nkept", page)
    assert write_docs(report(), page) == ["trials", "priority"]
    sections = read_sections(page)
    assert sections["learning"].endswith("kept")
    assert "| ten stacked | 49/50 | 98.0 % |" in sections["trials"]
    assert "| ten stacked | 43/50 | 86.0 % |" in sections["trials"]
    assert "| depth only | ten stacked | 40/50 |" in sections["priority"]
    for picture in re.findall(r"\]\((pictures/[^)]*)\)", page.read_text()):
        assert Image.open(page.parent / picture).width > 300


def test_the_page_is_one_file_of_closed_tags(tmp_path):
    text = write_page(report(), tmp_path / "trials.html").read_text()
    outside = re.findall(r"(?:src|href)=[\"'](?!data:|#)[^\"']*", text)
    assert outside == []
    assert "49/50" in text and "compare priority" in text and text.count("<svg") == 4

    class Tags(HTMLParser):
        def __init__(self):
            super().__init__()
            self.open = []

        def handle_starttag(self, tag, attributes):
            if tag not in ("meta", "img", "br"):
                self.open.append(tag)

        def handle_endtag(self, tag):
            assert self.open.pop() == tag

    tags = Tags()
    tags.feed(text)
    assert tags.open == []


def test_a_film_camera_sees_its_target_in_the_middle_and_upright():
    eye, target = np.array([1.0, -0.6, 0.8]), np.array([0.3, 0.2, 0.1])
    T = looking_at(eye, target)
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(T[:3, :3]) > 0
    seen = np.linalg.inv(T) @ [*target, 1.0]
    assert np.allclose(seen[:2], 0) and np.isclose(seen[2], np.linalg.norm(target - eye))
    above = np.linalg.inv(T) @ [*target + [0, 0, 0.1], 1.0]
    assert above[1] < 0 and np.isclose(above[0], 0)  # image y points down


def test_a_film_keeps_frames_order_and_the_longer_end(tmp_path):
    shades = [40, 120, 200]
    frames = [Frame(float(i), np.full((40, 60, 3), s, np.uint8)) for i, s in enumerate(shades)]
    write_gif(tmp_path / "film.gif", frames, ["a", "b", "c"], frame_ms=70, hold_ms=2000)
    film = Image.open(tmp_path / "film.gif")
    assert film.n_frames == 3
    for i, shade in enumerate(shades):
        film.seek(i)
        assert abs(int(film.convert("RGB").getpixel((30, 20))[0]) - shade) < 12
    assert film.info["duration"] == 2000
