// Cameras that move by themselves beside the clip's own: in a loop of so many seconds, while time stands still or plays.

const LOOPS = { swing: 5, dolly: 6, wiggle: 1.28 };
const EYES = 0.03;  // between two eyes, over the median depth of the clip

/** `camera` moved to its right, so that what is at planar depth `distance` stays in its place. */
function shifted({ rotation, translation: [x, y, z], lens: [fx, fy, cx, cy] }, offset, distance) {
  return { rotation, translation: [x - offset, y, z], lens: [fx, fy, cx + (fx * offset) / distance, cy] };
}

/** `camera` moved back until planar depth `distance` is `factor` times as far, and zoomed to show it as large. */
function dollied({ rotation, translation: [x, y, z], lens: [fx, fy, cx, cy] }, distance, factor) {
  return { rotation, translation: [x, y, z + distance * (factor - 1)], lens: [fx * factor, fy * factor, cx, cy] };
}

/** Left and right. */
function eyesOf(camera) {
  return [-1, 1].map((side) => shifted(camera, (side * EYES) / 2, 1));
}

/** Planar depth of what moves, at a clip time; `depths` are at even steps of the clip. */
function subjectAt(depths, time) {
  const place = Math.min(Math.max(time, 0), 1) * (depths.length - 1);
  const before = Math.floor(place);
  const after = Math.min(before + 1, depths.length - 1);
  return depths[before] + (place - before) * (depths[after] - depths[before]);
}

class CameraLoops {
  constructor(about) {
    this.about = about;
    this.turning = new FreeCamera(about.clipPath);
    this.phase = 0;
  }

  step(mode, seconds) {
    this.phase = (this.phase + (2 * Math.PI * seconds) / LOOPS[mode]) % (2 * Math.PI);
  }

  /** The camera of a mode of `LOOPS` at a clip time. */
  camera(mode, time) {
    const base = cameraOnPath(this.about.clipPath, time);
    if (mode === "swing") {
      const width = (this.about.swing * Math.PI) / 180;  // half of it to either side; half as high
      this.turning.startFrom(base);
      this.turning.orbit(width * Math.sin(this.phase), (-width * (1 - Math.cos(this.phase))) / 4);
      return this.turning.camera;
    }
    const subject = subjectAt(this.about.subjectDepths, time);
    if (mode === "dolly") return dollied(base, subject, this.about.dolly ** ((1 - Math.cos(this.phase)) / 2));
    return shifted(base, (EYES / 2) * Math.sin(this.phase), subject);
  }
}
