"""From tracks to a prediction for a shape that was never filmed."""

import rafl

# Build a dataset from tracks, and keep it.
dataset = rafl.build_dataset("specimen.yaml", "tracks/", "recordings.csv")
rafl.write_dataset("beam.h5", dataset)

# Fit a model. The call writes the run folder and returns the model.
model = rafl.fit("beam.h5", "runs/beam", epochs=4)  # a real fit: leave epochs out

# Errors [mm] of the baseline simulator (`original`) and the model, by recording.
errors = rafl.evaluate({"rafl": model}, [dataset])
print(errors.groupby("method")["mean_mm"].mean())

# Simulate the recorded motions. Positions are numpy arrays in metres.
motion = rafl.simulate(dataset, model)["load080g"]
print(motion.markers.shape)  # (frames, markers, 3)

# Predict another specimen, let go from rest under 50 g.
other = rafl.read_specimen("longer.yaml")
prediction = rafl.predict(other, rafl.load_model("runs/beam"), load_g=50, frames=20)
prediction.table().to_csv("prediction.csv", index=False)  # frame, time_s, marker, x_mm, ...
