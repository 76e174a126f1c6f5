"""CANopen (CiA 301) on the host: one node at a time, in the host's own time.

The ``canopen`` package reads the EDS files, keeps the object dictionary, maps PDOs and runs SDO, NMT and EMCY. By
itself it would receive in a thread of its own and wait in real time; here it does neither. `network` gives it a bus
that sends through a `drivers.api.FrameLink`, and an SDO client that waits by `Clock.wait`, so that everything works in
virtual time too, and no driver needs a lock. `node` is what the drivers use: it takes in the frames and says what went
wrong; `objects` reads and writes by SDO. `pdo` decodes many frames at once.
"""
