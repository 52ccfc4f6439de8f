from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.emulator.plant import MotorCommand, Plant

TOP = 7000.0
goals = st.floats(0, 4095).map(round)


def moved(start: float, drive: MotorCommand | None, *times_s: float) -> Plant:
    plant = Plant(float(start), reference=float(start))
    for time_s in times_s:
        plant.advance(time_s, drive)
    return plant


@given(goals, goals, st.lists(st.floats(0, 1), max_size=20))
def test_where_it_is_does_not_depend_on_how_often_one_looks(start, goal, looks):
    drive = MotorCommand(float(goal), TOP)
    assert moved(start, drive, *sorted(looks), 1.0) == moved(start, drive, 1.0)


@given(goals, goals, st.sampled_from([0.0, 1500.0]), st.sampled_from([0.0, 20000.0]))
def test_goal_is_reached_without_overshoot_and_below_top_speed(start, goal, speed, acceleration):
    drive = MotorCommand(float(goal), TOP, speed, acceleration)
    plant = Plant(float(start), reference=float(start))
    low, high = min(start, goal), max(start, goal)
    for k in range(2000):
        plant.advance(k * 0.002, drive)
        assert abs(plant.speed) <= TOP and low - 10 <= plant.position <= high + 10
    assert plant.position == goal and plant.speed == 0.0


@given(goals, st.floats(0, 100))
def test_without_torque_it_stays(start, time_s):
    assert moved(start, None, time_s).position == start


def test_a_profile_is_kept():
    plant = moved(0, MotorCommand(4000.0, TOP, 1000.0, 0.0), 1.0)
    assert abs(plant.reference - 1000.0) < 5.0 and abs(plant.speed - 1000.0) < 5.0
    plant = moved(0, MotorCommand(4000.0, TOP, 3000.0, 2000.0), 0.5)
    assert abs(plant.reference_speed - 1000.0) < 10.0


def test_time_going_back_changes_nothing():
    drive = MotorCommand(3000.0, TOP)
    assert moved(2000, drive, 0.1, 0.05) == moved(2000, drive, 0.1)
