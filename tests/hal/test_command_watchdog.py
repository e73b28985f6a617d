import pytest

from hal.errors import CommandRefused
from hal.safety.watchdog import CommandWatchdog


@pytest.fixture
def watchdog():
    watchdog = CommandWatchdog(time_to_live=0.1, period=0.005)
    for cycle in range(1, 301):
        watchdog.note(cycle, 10.0 + 0.005 * cycle)
    return watchdog


def test_a_command_lives_from_the_cycle_it_answers(watchdog):
    now = 10.0 + 0.005 * 300
    assert watchdog.expiry(300, now) == pytest.approx(now + 0.1)
    assert watchdog.expiry(290, now) == pytest.approx(now + 0.05)


@pytest.mark.parametrize(
    ("cycle", "report"),
    [(301, "has not been"), (0, "has not been"), (-5, "has not been"), (279, "105 ms"), (1, "299 cycles")],
)
def test_commands_from_no_known_cycle_are_refused(watchdog, cycle, report):
    with pytest.raises(CommandRefused, match=report):
        watchdog.expiry(cycle, 10.0 + 0.005 * 300)


def test_before_the_first_cycle_nothing_is_accepted():
    with pytest.raises(CommandRefused, match="restarted"):
        CommandWatchdog(0.1, 0.005).expiry(1, 0.0)
