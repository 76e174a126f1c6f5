"""The host's side of each device: transports, protocols, gyros and stages. Knows no emulator."""
