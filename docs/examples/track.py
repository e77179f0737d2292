"""From board images and videos to 3-D positions."""

from pathlib import Path

import rafl

rig = rafl.calibrate("calibration/")
rafl.write_calibration("calib.yaml", rig)

tracks = rafl.track("videos/", "calib.yaml", "specimen.yaml")
for name, recording in tracks.items():
    rafl.write_tracks(Path("tracks") / f"{name}.h5", recording)
    measured = (recording.state == 1).mean()
    print(name, recording.position.shape, f"{100 * measured:.1f} % measured")

# One row per frame and marker: position and sigma in mm, and whether it was measured, filled or missing.
table = rafl.read_tracks("tracks/load080g.h5").table()
print(table.head())
