"""What runs on the controllers of the gyro and of the stage.

Written in the subset of Python that MicroPython runs (only ``struct`` and ``array`` are imported), against the small
interfaces of ``hardware``. Implements ``docs/protocol.md`` by hand, apart from the host's codec, so that a mistake in
one cannot hide in the other. A device is a function of time: ``feed(data, now_us)`` takes what came over the line,
``poll(now_us)`` returns what to send, ``next_due_us()`` tells when there will be something to do.
"""
