"""--set: a copy of config/ with single keys changed."""

import pytest
import yaml

from iwgnet_grasp.overrides import OverrideError, changed_config, parse_overrides
from iwgnet_grasp.trials.worker import PACKAGE

CONFIG = PACKAGE / "config"


def read(folder, name):
    return yaml.safe_load((folder / f"{name}.yaml").read_text())


def test_a_changed_config_differs_in_the_named_keys_only():
    overrides = parse_overrides(["priority.alpha=0.5", "motion.planner.seed=7"])
    with changed_config(CONFIG, overrides) as folder:
        assert read(folder, "priority") == {**read(CONFIG, "priority"), "alpha": 0.5}
        motion = read(CONFIG, "motion")
        motion["planner"]["seed"] = 7
        assert read(folder, "motion") == motion
        assert read(folder, "physics") == read(CONFIG, "physics")
    assert not folder.exists()
    assert read(CONFIG, "priority")["alpha"] != 0.5


def test_without_changes_the_config_itself_is_used():
    with changed_config(CONFIG, {}) as folder:
        assert folder == CONFIG


def test_a_whole_number_stays_a_float_where_one_was():
    with changed_config(CONFIG, parse_overrides(["motion.grip_force=70"])) as folder:
        assert "grip_force: 70.0" in (folder / "motion.yaml").read_text()


@pytest.mark.parametrize(
    "text, says",
    [
        ("priority.alhpa=1", "did you mean 'alpha'"),
        ("priorty.alpha=1", "did you mean 'priority'"),
        ("motion.planner.sed=1", "motion.planner has no key 'sed'; did you mean 'seed'"),
        ("priority.alpha.beta=1", "priority.alpha has no key 'beta'"),
        ("priority.alpha=high", "must be a number"),
        ("motion.limits.max_velocity=[1, 2]", "must be a list of 6"),
        ("motion.planner=3", "must be a group of keys"),
        ("alpha=1", "FILE.KEY=VALUE"),
        ("priority.alpha", "FILE.KEY=VALUE"),
        ("priority.alpha=", "FILE.KEY=VALUE"),
        ("priority.alpha=[1", "not a YAML value"),
    ],
)
def test_what_cannot_be_set_is_named_in_one_line(text, says):
    with pytest.raises(OverrideError) as caught, changed_config(CONFIG, parse_overrides([text])):
        pass
    assert says in str(caught.value) and "\n" not in str(caught.value)
