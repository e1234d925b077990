"""Every threshold of the audit, with its reason. Pairs are (suspect, bad).

All were chosen so that simulated motion without noise passes and the flaws of known public recordings are found. Where
a number comes from hardware, its comment says so.
"""

from __future__ import annotations

import math

from go1exp.robot.go1_fields import TORQUE_STEP

# ---------------------------------------------------------------------- clock

RATE = (0.02, 0.10)  # relative distance of the median step from 1 / ``rate_hz``: 2 % shifts a 20 s chirp by 0.4 s
JITTER = (0.10, 0.50)
"""Standard deviation of the steps over their median: a tenth of 2 ms is the encoder noise of a joint at 2 rad/s."""
COUNTED = 1e-6  # the same below which a clock was counted, not read
GAP_STEPS = 1.8
"""A step longer than this many medians (and 6 robust deviations more than one) is a gap: a sample is missing."""
GAPS = (0.0, 0.02)
"""Share of missing samples: any is reported; with 2 %, every tenth of a second has a derivative that is wrong."""
LONGEST_GAP = 0.1  # s; longer ones are bad: half a stride is missing
LEAST_STEP = 5e-5
"""s; no joint is logged in shorter steps (20 kHz; chosen: actuators that log every control cycle reach 10)."""

# ---------------------------------------------------------------------- single channels

REPEATS = (0.01, 0.20)
"""Share of samples that repeat the last value although the channel moves, beyond what its step explains."""
ENOUGH = 50  # fewest samples from which a share or a scale is computed
SURE = 4.0  # standard deviations (of a count) by which stale samples must exceed chance
ENOUGH_NOISE = 500
"""Fewest samples from which a noise floor is checked; shorter recordings (a second of walking) are mostly motion."""
COARSE_ANGLE = 4e-3  # rad; a coarser encoder than any known one (the coarsest, 2 pi / 4096, is 1.5e-3)
NOISE = {"rad": (5e-3, 2e-2), "rad/s": (0.5, 2.0), "N m": (1.0, 5.0), "m/s2": (2.0, 10.0)}
"""White noise by unit: about five times that of actuators of this class (0.2 to 1 mrad, 0.05 rad/s, 0.15 N m)."""
WHITE = (0.8, 1.25)
"""Estimates of noise by third and by fifth differences agree within this ratio if the signal is noise, not motion."""
FROZEN_TIME, FROZEN_ANGLE = 1.0, 0.5
"""s and rad: an angle without any change for this time, while its target moved this far, is not being read
(soft servos with coarse encoders stick for 0.7 s and 0.8 rad, and for 12 s and 0.2 rad)."""
FROZEN_ONCE, FROZEN_ONCE_ANGLE = 20.0, 0.15
"""Where its second longest rest is so many times shorter, the target needs to move no further than this, rad: an
encoder with noise, or a joint that is always moved, rests for some samples (0.03 s on simulated Go1s)."""
PLATEAU = 5  # consecutive samples at the extreme value, entered and left at speed, that count as clipped
CLIPPED = (0.0, 0.05)  # share of clipped samples: any is suspect; a twentieth is bad
CONTINUOUS = 2.0**-22  # steps below this share of the largest value are those of 32-bit floats, not of a sensor

KNOWN_STEPS = {
    "rad": {
        "12 bits a turn (Dynamixel XL330, Feetech STS3215)": 2 * math.pi / 4096,
        "14 bits a turn": 2 * math.pi / 16384,
        "14 bits a turn behind 6.33:1 (Unitree Go1 hip and thigh)": 2 * math.pi / 16384 / 6.33,
        "14 bits a turn behind 9.5:1 (Unitree Go1 calf)": 2 * math.pi / 16384 / 9.5,
        "15 bits a turn behind 6.33:1 (Unitree GO-M8010-6 class)": 2 * math.pi / 32768 / 6.33,
        "15 bits a turn behind 9.5:1 (Unitree calf)": 2 * math.pi / 32768 / 9.5,
        "16 bits over 25 rad (T-Motor AK series, CAN)": 25 / 65535,
    },
    "rad/s": {"12 bits over 45 rad/s (T-Motor AK80-6, CAN)": 45 / 4095},
    "N m": {
        "12 bits over 24 N m (T-Motor AK80-6, CAN)": 24 / 4095,
        "1/256 N m (Unitree Go1, low-level packets)": TORQUE_STEP,
    },
}
"""Unit -> steps of encoders and messages in use; a step within ``KNOWN`` of one of its unit is called by its name."""
KNOWN = 2e-3  # relative error: a step is found to better than a thousandth, and the closest two differ by five

# ---------------------------------------------------------------------- channels against one another

SCALE = (0.05, 0.20)
"""Relative error of a scale (speed against the change of angle, gyroscope against attitude) beyond its uncertainty."""
LAG_RANGE = 0.06  # s: largest lag, in either direction, at which a speed is compared with its angle
LAG = 4e-3
"""s beyond one sample period, but of that no more than as much again: a speed that trails its angle by more was
filtered, or read at another time. At 49 Hz a whole sample is 20 ms, a fifth of what a joint needs for a step."""
LAG_GAIN = 1.5  # unexplained part at no lag over that at the best lag: below this ratio the lag may be chance
MOTION = 5.0
"""A change of angle, or an expected torque, must exceed its noise this many times to be compared with a channel."""
TORQUE_SCALE = (0.15, 0.50)
"""As ``SCALE``, for the reported torque against the PD law; strength and gains of real motors are off by 5 to 15 %."""
TORQUE_LAG = 0.04  # s: largest lag of a torque behind the control law; commands to a Go1 arrive up to 40 ms late
FARTHER = 2.0
"""Factor on 180 / pi within which an angle that moves so many times as far as its target has another unit: the answer
of an actuator is between a half and twice its target."""
UNIT_SCALES = {"degrees instead of radians": 180 / math.pi, "milliseconds instead of seconds": 1e-3}
"""Scales that have a name, recognised within a tenth."""
RELATED = 0.5  # correlation below which two channels that should follow one another do not
CLEARLY = 0.7  # correlation above which a sign is certain, and another joint can be a better match
BETTER = 0.25  # the correlation with another joint must exceed that with the joint itself by this
LAW, LAW_PART = 0.9, 0.1
"""Share of a reported torque that target, angle and speed must explain before they show a sign, and least spread of
the parts of target and angle against that of the torque."""
ALIKE = 0.9999  # correlation of target and angle above which a law of both shows nothing
LEAST_TIME = 2.0
"""s of motion below which order, sign and delay are not checked: any two slow curves of one second look alike."""
DELAY = 8e-3
"""s beyond one sample period: an intact bus and actuator respond within it. (A Go1 under a policy has 20 ms.)"""
DELAY_SPREAD = 5e-3  # s between joints, beyond their uncertainty: they were not sampled together
DELAY_RECORDINGS = 8e-3
"""s between recordings of one robot, beyond their uncertainty: other gains change what a joint answers by less. (102
sound simulated sets with hidden effects, actuators that lag among them: up to 3 ms.)"""
DELAY_JOINTS = 0.5  # share of a recording's joints that must show a delay before it is one of the recording
DELAY_RANGE = (-0.11, 0.16)  # s; delays that are searched. Longer ones are not delays of an actuator
DELAY_POWER = 0.6
"""Share of the acceleration left unexplained by angle, speed and neighbours that the command must explain: below it
the delay is not given."""
DELAY_FACTOR = 2.5
"""Factor on the jackknife error of a delay. On simulated suspended Go1s without delay, the true error was up to five
times that on chirps and slow ramps (forces of other joints), and about once that on steps and sums of sines."""
DELAY_SAMPLES = 0.25
"""Samples; error of a delay because motion between samples is not known (measured: a fifth of a sample at 50 Hz)."""
DELAY_ERROR = 4e-3  # s; delays with a larger standard error are not given: the motion was too smooth to tell
GRAVITY_ERROR = (0.06, 0.15)  # relative error of the accelerometer at rest: 6 % is a poor calibration
TILT = (10.0, 30.0)
"""Degrees between the mean of the accelerometer and the vertical of the attitude: walking alone gives a few."""
POSITION_MARGIN = (0.08, 0.3)
"""rad beyond a hard stop: 5 degrees can be play, a soft stop and a zero offset; 17 are a wrong unit, order or sign."""
EXCEEDED = 1.25
"""Torque and speed may exceed their limit by this factor: limits are nominal; an ideal actuator has no speed limit."""

# ---------------------------------------------------------------------- columns that hold another quantity

COPIED = 0.15
"""Share of the rows in which two columns change where they are equal (chosen: 0.07 of coarse torques are by chance)."""
FAST_STEPS, ROUNDED = 20.0, 0.97
"""Times the rounding of a copy by which an angle must move within two rows, and share of these rows that must agree
(a joint that follows 0.5 ms behind: 0.65 at most)."""
COPY_ROWS = 4000  # rows by which most pairs of columns are told apart
DERIVED, SAME_NOISE = 0.8, 0.3
"""Share of rows in which a channel is so near to what an angle gives, in standard deviations of the angle's noise
in it. Of an independent reading 0.24 are."""
FITTED, LAW_ROWS = 0.7, 3
"""Share of the rows that a law of a copy is fitted to (others may be clipped), and rows by which it may be late."""
IDEAL = 3e-6  # noise of a channel over its range below which no sensor read it

# ---------------------------------------------------------------------- samples that neighbours rule out

FASTEST = 60.0  # rad/s; no joint of unknown speed turns faster (chosen: twice the actuators of this class)
REVERSED = 12.0  # rad/s; no joint turns out and back at such a speed within one sample (chosen)
TURNS = 1.0  # rad/s of the angles at which joints that read no speed are misread (chosen: far above an encoder's noise)
UNUSUAL = 10.0  # times the 90 % quantile of what a channel goes out and back within a sample; also for noise
ZERO_JUMP = 8.0  # times the 95 % quantile of a channel's steps, by which rows of zeros must be entered and left
LOST_ROWS, LOST_STEPS = 3, 20.0
"""Longest run of zeros in one channel that is a few lost readings, and resolutions by which both neighbours are off."""
SPANS = 5.0
"""Spans of 99 % of a channel by which a torque or a reading of the IMU must lie outside; impacts are spikes, too."""
WRAPPED, MOVES = 0.9, 10.0
"""Share of all that an angle reads that each jump of a counter must span, and least motion in largest other steps."""
HALF_RANGE, EXACT, SAME_RANGE = 0.25, 0.9, 0.15
"""Share of a counter's range by which speeds may be off whole turns of it; share of the rows that must follow a rule of
counters; and relative departure of what is read from that range."""
LEFT = (3, 0.1)  # fewest targets that leave those beside them for a row, and largest share: more are an excitation
LEFT_STEPS, LEFT_REST = 5.0, 0.2
"""Times the 95 % quantile of a target's steps by which it must leave, and share of that by which it may else move."""
LEFT_RANGE = (1.0, 2.0)  # rad, and spans of 96 % of the targets, by which one lies far outside
SHORT_STEP, HELD_ROWS = 6e-3, 4  # s; no command is held for a row of less where others are held for so many rows
OBEYED = 5.0  # standard errors by which torque, speed or angle answer targets that were commanded
MOST_IMPOSSIBLE = 0.2  # share of impossible rows above which a recording is refused and not only those rows

# ---------------------------------------------------------------------- motion in the episode

STILL_TIME = 0.5  # s; the shortest stretch that counts as still
STILL_ANGLE = 5e-3  # rad; joints that move less within that time stand still
STILL_SHARE = 0.99  # a recording in which the robot rests for more than this share cannot be used to identify anything
