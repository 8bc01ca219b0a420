// What is seen on the canvas as a WebM file, made by the browser itself.

const RECORDING_TYPES = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];
const RECORDING_FPS = 30;
const RECORDING_BITS = 12e6;  // a second

class Recording {
  static get type() {
    return window.MediaRecorder && HTMLCanvasElement.prototype.captureStream
      ? RECORDING_TYPES.find((type) => MediaRecorder.isTypeSupported(type)) : undefined;
  }

  /** `take` gets the video when it is there. */
  constructor(canvas, take) {
    const parts = [];
    this.recorder = new MediaRecorder(canvas.captureStream(RECORDING_FPS), { mimeType: Recording.type, videoBitsPerSecond: RECORDING_BITS });
    this.recorder.ondataavailable = ({ data }) => parts.push(data);
    this.recorder.onstop = () => take(new Blob(parts, { type: "video/webm" }));
    this.recorder.start();
  }

  stop() {
    this.recorder.stop();
    for (const track of this.recorder.stream.getTracks()) track.stop();
  }
}

/** Let the browser save a file. */
function save(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
