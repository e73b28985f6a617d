"""Sensors of a simulated car: wheels, yaw rate, steering angle, accelerations, torque and current of the motor.

A single-track model with a lag of the tyres, driven to random speeds and steering angles over random slopes; it also
stands. Each sensor has white noise.
"""

from itertools import combinations

import numpy as np

BASE, FRONT, TRACK, RADIUS, GEAR = 2.7, 1.3, 1.55, 0.31, 9.0
"""Wheelbase, distance of the front axle from the centre of gravity, track and wheel radius [m], and gear ratio."""
UNDERSTEER, TYRES, ENGINE = 0.0035, 0.15, 0.3
"""Understeer [s2/m2], and time constants of the yaw rate and of the acceleration [s]."""
MASS, DRAG, ROLLING, ROLLS, GRAVITY = 1500.0, 0.4, 150.0, 0.2, 9.81
"""Mass [kg], drag [N s2/m2], rolling resistance [N], the speed at which it has three quarters of it [m/s], and g."""
SLIP = 0.004
"""Slip of the driven wheels by acceleration [s2/m]."""
VOLTAGE, IDLE = 370.0, 3.0
STEP = 100.0
"""Steps of the simulation per second, a multiple of every rate: with steps of 0.2 s the tyres would be others."""
SPEEDS = (0.0, 5.0, 10.0, 15.0, 20.0, 28.0)
NOISE = {
    "wheel_speed": 0.03, "yaw_rate": 0.004, "steering_angle": 0.003, "acceleration": 0.08, "motor_torque": 1.0,
    "motor_current": 0.5,
}  # fmt: skip
"""Standard deviations [m/s, rad/s, rad, m/s2, N m, A]."""
UNITS = {
    "wheel_speed": "m/s", "yaw_rate": "rad/s", "steering_angle": "rad", "acceleration": "m/s^2", "motor_torque": "N m",
    "motor_current": "A",
}  # fmt: skip
MASKS = [tuple(s for s in UNITS if s not in lost) for n in (1, 2) for lost in combinations(UNITS, n)]
"""One or two signals are inferred from all others."""


def drive(seed: int, seconds: float, rate: float) -> dict[str, np.ndarray]:
    """Return what the sensors measure at a rate [Hz] for some seconds, signal -> shape (n, size) [`UNITS`]."""
    draw, step, every = np.random.default_rng(seed), 1.0 / STEP, round(STEP / rate)
    speed, aim, gain, steering, turn, yaw, slope, climb = 0.0, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    rows = []
    for number in range(round(seconds * STEP)):
        if draw.random() < step / 8.0:
            aim = float(draw.choice(SPEEDS))
        if draw.random() < step / 4.0:
            turn = draw.normal(0.0, 0.25) * np.clip(8.0 / (speed + 1.0), 0.1, 1.5)
        if draw.random() < step / 20.0:
            climb = draw.normal(0.0, 0.02)
        slope += (climb - slope) * step / 5.0
        steering += np.clip(turn - steering, -0.5 * step, 0.5 * step)
        gain += (np.clip(0.5 * (aim - speed), -3.5, 2.5) - gain) * step / ENGINE
        before, speed = speed, max(0.0, speed + gain * step)
        yaw += (speed * steering / (BASE * (1.0 + UNDERSTEER * speed**2)) - yaw) * step / TYRES
        real = (speed - before) / step  # a car that stands does not slow down
        felt = real + GRAVITY * slope
        force = MASS * felt + DRAG * speed**2 + ROLLING * np.tanh(speed / ROLLS)
        if number % every == 0:
            rows.append([speed, yaw, steering, real, felt, force])
    speed, yaw, steering, real, felt, force = np.array(rows).T
    front, half = np.hypot(speed, FRONT * yaw), 0.5 * TRACK * yaw
    driven = 1.0 + SLIP * real
    wheels = [
        driven * (front - half * np.cos(steering)), driven * (front + half * np.cos(steering)), speed - half,
        speed + half,
    ]  # fmt: skip
    true = {
        "wheel_speed": np.stack(wheels, axis=1),
        "yaw_rate": yaw[:, None],
        "steering_angle": steering[:, None],
        "acceleration": np.stack([felt, speed * yaw], axis=1),
        "motor_torque": (force * RADIUS / GEAR)[:, None],
        "motor_current": (force * speed / VOLTAGE + IDLE)[:, None],
    }
    return {name: value + NOISE[name] * draw.standard_normal(value.shape) for name, value in true.items()}
