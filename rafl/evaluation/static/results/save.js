// The view saved as a picture or a video.

const VIDEO_TYPES = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"];
const FRAMES_PER_S = 60;
const VIDEO_BITS_PER_S = 12e6;

export function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

// A name for files: letters that file systems or shells take for something else become a dash.
export function fileName(...parts) {
  return parts.map((part) => part.replace(/[^\p{L}\p{N}._-]+/gu, "-")).join("-") || "results";
}

function compose(scene, canvas) {
  const pen = canvas.getContext("2d");
  pen.drawImage(scene.canvas, 0, 0, canvas.width, canvas.height);
  pen.drawImage(scene.labels, 0, 0, canvas.width, canvas.height);
}

function copyOf(scene) {
  const canvas = document.createElement("canvas");
  // Video codecs want even sizes.
  canvas.width = scene.canvas.width - (scene.canvas.width % 2);
  canvas.height = scene.canvas.height - (scene.canvas.height % 2);
  return canvas;
}

export async function savePicture(scene, name) {
  scene.draw();
  const canvas = copyOf(scene);
  compose(scene, canvas);
  const blob = await new Promise((done) => canvas.toBlob(done, "image/png"));
  download(blob, `${name}.png`);
}

// Plays once from the first frame to the last, and saves what is shown. Resolves to whether a video was saved: it is not
// if playing was stopped.
export function saveVideo(scene, player, name) {
  const type = VIDEO_TYPES.find((one) => window.MediaRecorder?.isTypeSupported(one));
  if (!type) throw new Error("this browser records no videos; save pictures instead");
  const canvas = copyOf(scene);
  compose(scene, canvas);
  const recorder = new MediaRecorder(canvas.captureStream(FRAMES_PER_S), {
    mimeType: type,
    videoBitsPerSecond: VIDEO_BITS_PER_S,
  });
  const parts = [];
  let complete = false;
  recorder.addEventListener("dataavailable", (event) => event.data.size && parts.push(event.data));
  return new Promise((done, failed) => {
    recorder.addEventListener("error", () => failed(new Error("this browser could not record the video")));
    recorder.addEventListener("stop", () => {
      if (complete) download(new Blob(parts, { type }), `${name}.${type.startsWith("video/mp4") ? "mp4" : "webm"}`);
      done(complete);
    });
    const copy = () => {
      if (recorder.state !== "recording") return;
      if (!player.playing) {
        recorder.stop();
        return;
      }
      compose(scene, canvas);
      requestAnimationFrame(copy);
    };
    player.stop();
    player.go(0);
    recorder.start(500);
    player.play(() => {
      complete = true;
      recorder.stop();
    });
    requestAnimationFrame(copy);
  });
}
