"""What of a robot file with drives in MIT mode is refused before anything is opened."""

import pytest
from mit_bench import DAMIAO, T_MOTOR, description, mit_bench

from hal.errors import ConfigError


def refused(**changes):
    with pytest.raises(ConfigError) as caught:
        mit_bench(description(**changes))
    return str(caught.value)


def kinds(damiao=None, t_motor=None):
    return {
        "damiao": {"driver": "mit", "settings": DAMIAO if damiao is None else damiao},
        "t_motor": {"driver": "mit", "settings": T_MOTOR if t_motor is None else t_motor},
    }


def test_an_unknown_motor():
    text = refused(kinds=kinds({**DAMIAO, "motor": "DM4711"}))
    assert "no motor 'DM4711'" in text
    assert "DM4310" in text
    assert "ranges" in text


def test_a_motor_of_ones_own():
    own = {"position": 12.5, "velocity": 30.0, "effort": 10.0, "layout": "damiao"}
    mit_bench(description(kinds=kinds({**DAMIAO, "motor": "mine", "ranges": own})))
    text = refused(kinds=kinds({**DAMIAO, "motor": "mine", "ranges": {**own, "layout": "katz"}}))
    assert "layout" in text
    del own["layout"]
    assert "no motor 'mine'" in refused(kinds=kinds({**DAMIAO, "motor": "mine", "ranges": own}))


def test_no_watchdog():
    settings = {**T_MOTOR, "allow_no_watchdog": False}
    text = refused(kinds=kinds(t_motor=settings))
    assert "no watchdog" in text
    assert "allow_no_watchdog: true" in text


def test_limits_that_do_not_fit():
    text = refused(limits={"joint_position": {"low": -3.0, "high": 13.0}})
    assert "-12.5 to 12.5" in text
    assert "limits.joint_position" in text
    assert "-inf to inf" in refused(limits={})
    geared = {**DAMIAO, "gear": 5.0}
    assert "-2.5 to 2.5" in refused(kinds=kinds(geared))


def test_gains_that_do_not_fit():
    assert "at most 500" in refused(kinds=kinds({**DAMIAO, "stiffness": 600.0}))
    assert "damping 40 is more" in refused(kinds=kinds({**DAMIAO, "damping": 40.0}))
    assert "20000 at most" not in refused(kinds=kinds({**DAMIAO, "stiffness": 600.0, "gear": 1.05}))
    assert "stiffness" in refused(kinds=kinds({**DAMIAO, "stiffness": 0.0}))


def test_a_gear_of_zero():
    assert "gear" in refused(kinds=kinds({**DAMIAO, "gear": 0}))


def test_drives_that_cannot_be_told_apart():
    devices = description()["devices"]
    devices["wrist_drive"] = {**devices["wrist_drive"], "kind": "damiao", "node": 17, "settings": {"master_id": 17}}
    text = refused(devices=devices)
    assert "cannot be distinguished" in text


def test_answers_that_another_drive_would_take_for_commands():
    devices = description()["devices"]
    devices["wrist_drive"] = {**devices["wrist_drive"], "node": 17}  # the elbow answers under 11h
    assert "011h" in refused(devices=devices)
    assert "011h" in refused(devices=dict(reversed(devices.items())))
    devices["wrist_drive"] = {**devices["wrist_drive"], "node": 2, "settings": {"master_id": 2}}
    mit_bench(description(devices=devices))  # under its own id it harms nobody


def test_makes_that_share_an_identifier():
    devices = description()["devices"]
    devices["elbow_drive"] = {**devices["elbow_drive"], "settings": {"master_id": 0}}
    assert "identifier 000h" in refused(devices=devices)


def test_an_id_out_of_range():
    devices = description()["devices"]
    devices["elbow_drive"] = {**devices["elbow_drive"], "node": 0}
    assert "between 1 and" in refused(devices=devices)


def test_a_watchdog_that_one_lost_frame_would_trip():
    assert "one lost frame" in refused(rates={"hal": 50}, kinds=kinds({**DAMIAO, "watch_time": 0.05}))


def test_a_mini_cheetah_measures_no_effort():
    settings = {**T_MOTOR, "motor": "mini-cheetah", "mode": "effort"}
    assert "no torque" in refused(kinds=kinds(t_motor=settings))
