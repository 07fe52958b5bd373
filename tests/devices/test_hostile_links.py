"""The links under attack: nothing stale is believed, nothing impossible, and no motion outlives its asker."""

import time
from concurrent.futures import ThreadPoolExecutor

import hostile
import pytest
from hostile import FALSE, SPOILS, TRUE, WRONG_DEG, WRONG_MM, Proxy, rsi_streams

from weldscan import DeviceError
from weldscan.devices import backend
from weldscan.devices.robots.plausible import distance
from weldscan.devices.robots.rsi import RsiRobot, RsiSettings
from weldscan.devices.robots.rsi_answer import IPOC, Order, answer
from weldscan.simulated.controllers import Arm

TIMEOUT_S, RECONNECT_S = 0.15, 0.3
LATE_S = 2.0
"""How far beyond its time-out an error may come: on a machine that others load too, with four of these at once."""
STREAMS = rsi_streams()


# --- RSI: freshness is order ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def listener():
    with RsiRobot(RsiSettings(port=0, timeout_s=0.3)) as robot:
        yield robot


def believed_of(robot, packets):
    """What a robot makes of packets by a clock of their own: sent when they say, and looked at one by one."""
    order, now_s, poses = Order(), 100.0, []
    robot._last = None
    for wait_s, sender, packet in packets:
        now_s += wait_s
        if answer(packet, "ImFree") is None or sender == 2:  # without one IPOC, or from another address
            continue
        if not order.fresh(sender, int(IPOC.findall(packet)[0]), packet, now_s):
            continue
        if wait_s == 0.0 and sender == 0:
            continue  # it had lain in the socket
        try:
            poses.append(robot._believed(robot._reading(packet, now_s)).flange)
        except (DeviceError, ValueError):
            continue
    return poses


BEGINNING = hostile.honest(FALSE, 1000, 60) + hostile.honest(TRUE, 1240, 60)


def test_honest_stream_is_believed(listener):
    poses = believed_of(listener, BEGINNING)
    assert len(poses) == 120 - 9  # all but those by which it is seen to grow
    assert poses[0] == FALSE
    assert poses[-1] == TRUE


@pytest.mark.parametrize("name", STREAMS)
def test_hostile_stream_is_not_believed(listener, name):
    """Nothing but `TRUE` after the honest beginning; and where an honest controller goes on, it is heard."""
    poses = believed_of(listener, BEGINNING + STREAMS[name])[111:]
    assert all(pose == TRUE for pose in poses)
    if "second sender" in name or name.startswith(("late packets", "a late packet")):
        assert len(poses) >= 60


def test_hostile_streams_over_udp(soak):
    """The same through sockets and the process that answers."""
    some = STREAMS if soak else {name: STREAMS[name] for name in ("ring of 30", "second sender ahead", "all zeros")}

    def attack(stream):
        with RsiRobot(RsiSettings(port=0, timeout_s=0.3, only_send=True)) as robot:
            return hostile.wrong_rsi_poses(robot, robot.port, stream)

    with ThreadPoolExecutor(3) as pool:
        found = dict(zip(some, pool.map(attack, some.values()), strict=True))
    assert {name: wrong for name, (_, wrong) in found.items() if wrong} == {}
    assert found["second sender ahead"][0] > 10


def test_stream_begins_again_only_after_silence(listener):
    again, silence = hostile.honest(TRUE, 40, 80), [(1.0, 0, b"")]
    assert len(believed_of(listener, BEGINNING + again)) == 111
    assert len(believed_of(listener, BEGINNING + silence + again)) == 111 + 31
    # The same packets once more are no new beginning, whatever silence is between.
    assert len(believed_of(listener, BEGINNING + silence + again + silence + again)) == 111 + 31
    other_port = [(wait, 1, packet) for wait, _, packet in again]
    assert len(believed_of(listener, BEGINNING + silence + other_port)) == 111 + 31


def test_first_packet_without_pose_is_skipped(listener):
    """A KR C2 sends one."""
    (wait, sender, first), *rest = BEGINNING
    without = b'<Rob Type="KUKA">' + first[first.index(b"<Delay") :]
    assert believed_of(listener, [(wait, sender, without), *rest])[0] == FALSE


# --- replies spoilt on their way --------------------------------------------------------------------------------------


def attacked(case):
    """Four poses through a proxy that spoils replies: how many were wrong, and the longest time that one took."""
    name, seed = case
    link, dialect = (("kvp", "kukavarproxy"), ("kvp", "c3"), ("eki", None))[seed % 3]
    options = {"dialect": dialect} if dialect else {}
    wrong = right = 0
    longest_s = 0.0
    with backend("controller", link)(Arm(TRUE), **({"c3": dialect == "c3"} if dialect else {})) as controller:
        proxy = Proxy(controller.port, SPOILS[name], seed)
        kind = backend("robot", link)
        settings = kind.Settings(port=proxy.port, timeout_s=TIMEOUT_S, reconnect_s=RECONNECT_S, **options)
        with kind(settings) as robot:
            proxy.on = True
            for _ in range(4):
                start_s = time.monotonic()
                try:
                    mm, deg = distance(robot.pose().flange, TRUE)
                except DeviceError:
                    pass
                else:
                    wrong += mm > WRONG_MM or deg > WRONG_DEG
                    right += mm <= WRONG_MM and deg <= WRONG_DEG
                longest_s = max(longest_s, time.monotonic() - start_s)
        proxy.close()
    return link, name, seed, wrong, right, longest_s


@pytest.mark.timeout(3600)
def test_spoilt_replies(soak):
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(attacked, hostile.tcp_cases(1000 if soak else 60)))
    assert [case for case in found if case[3]] == []
    assert sum(case[4] for case in found) > len(found) / 2  # it goes on working, too
    assert max(case[5] for case in found) < RECONNECT_S + LATE_S


# --- whoever asked goes away ------------------------------------------------------------------------------------------


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("link", ["kvp", "eki", "serial"])
def test_motion_does_not_outlive_its_asker(soak, link):
    kinds = ("INT", "TERM", "HUP", "KILL", "lost") if soak or link == "kvp" else ("INT", "lost")
    cases = [(link, kind, seed) for seed in range(50 if soak else 1) for kind in kinds]
    with ThreadPoolExecutor(12) as pool:
        found = dict(zip(cases, pool.map(lambda case: hostile.interrupted(*case), cases), strict=True))
    assert [case for case, after in found.items() if after.armed] == []
    assert {case: after.late_s for case, after in found.items() if after.late_s > hostile.RESPITE_S} == {}
    for (_, kind, _), after in found.items():
        assert after.travelled_mm <= (hostile.RESPITE_S + 0.5) * hostile.SPEED_MM_S
        if kind in ("INT", "TERM", "HUP"):
            told = ("the flange stands at", "before anything was asked", *["Look at the robot"] * after.let_go)
            assert any(state in after.said for state in told), after
