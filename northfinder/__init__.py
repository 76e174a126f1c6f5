"""Open north-finder: true azimuth and latitude from one vibratory gyro on a rotation stage.

Conventions, everywhere inside this package, ``drivers`` and ``sim_device``:

Units
    SI and radians: rates in rad/s, angles in rad, time in s, temperature in degrees Celsius. A name at an edge
    (configuration, command line, wire, report) that holds another unit says so: ``azimuth_deg``, ``bias_dph`` (deg/h).

Frames
    ``n``: local north, east, down. ``p``: pedestal, whose axes are the direction of stage azimuth zero, of stage
    azimuth 90 deg, and down along the rotation axis. Azimuth is clockwise seen from above, from true north for a true
    azimuth, from the encoder's zero for a stage azimuth. Elevation is up positive. Latitude is north positive.

Input axis
    At azimuth ``a`` and elevation ``e``: ``h = (cos e cos a, cos e sin a, -sin e)``. The earth's rotation in ``n`` is
    ``EARTH_RATE * (cos lat, 0, -sin lat)``, so an ideal gyro reads
    ``EARTH_RATE * (cos lat cos e cos a + sin lat sin e)``.

Tilt
    ``(tilt_x, tilt_y)``: how far the upper end of the rotation axis leans toward stage azimuth zero and toward stage
    azimuth 90 deg, measured by sensors fixed to the pedestal. Exactly: the pedestal is turned from level by the
    rotation vector ``(tilt_y, -tilt_x, 0)`` in its own axes.

Names
    ``_sd`` is a standard deviation, ``n_`` a count, ``vec_n`` a vector in frame n, ``mat_np`` takes a vector from p
    to n. Terms are those of IEEE Std 1431 (Coriolis vibratory gyros), 528 and 1559.
"""
