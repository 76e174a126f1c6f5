"""The world of the emulator: the earth's rotation, the gyro's noise, the stage's motion; all seeded.

The earth's rotation reaches the gyro by rotation matrices, never by a formula that an estimator would use.
"""
