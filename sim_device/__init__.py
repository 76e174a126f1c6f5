"""The device's side: firmware, the world it measures, faults, and servers. Knows no driver and no estimator."""
