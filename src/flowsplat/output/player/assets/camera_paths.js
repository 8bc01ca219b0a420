// Camera paths beside the clip's own, as player/camera_paths.py samples them: along the clip, or in a loop of so many seconds,
// while time stands still or plays.

const EYES = 0.03;  // between two eyes, over the median depth of the clip

/** Left and right, which see in the same place what is at the median depth. */
function eyesOf({ rotation, translation: [x, y, z], lens: [fx, fy, cx, cy] }) {
  return [-EYES / 2, EYES / 2].map((offset) => ({ rotation, translation: [x - offset, y, z], lens: [fx, fy, cx + fx * offset, cy] }));
}

/** `camera` moved by an offset: rotation (wxyz), place of the center, factors of the lens, shift of its center. */
function moved(camera, [w, x, y, z, right, down, forward, scaleX, scaleY, shiftX, shiftY]) {
  const axes = rowsOf(camera.rotation);
  const turn = rowsOf(rotationOf([w, x, y, z]));
  const [fx, fy, cx, cy] = camera.lens;
  const center = [right, down, forward].reduce((sum, step, k) => plus(sum, axes[k], step), centerOf(camera));
  const rotation = turn.flatMap((row) => [0, 1, 2].map((c) => row[0] * axes[0][c] + row[1] * axes[1][c] + row[2] * axes[2][c]));
  return cameraAt(center, rotation, [fx * scaleX, fy * scaleY, cx + fx * shiftX, cy + fy * shiftY]);
}

/** The offset of a loop at one of its times, at a phase from 0 to 2 pi: along the cubic curves (Catmull and Rom) through its rows. */
function offsetAt(rows, phase) {
  const place = ((phase / (2 * Math.PI)) * rows.length) % rows.length;
  const k = Math.floor(place);
  const at = rows[k];
  // A rotation is that of minus its quaternion, too.
  const [before, , next, after] = [-1, 0, 1, 2].map((step) => {
    const row = rows[(k + step + rows.length) % rows.length];
    const sign = [0, 1, 2, 3].reduce((sum, c) => sum + row[c] * at[c], 0) < 0 ? -1 : 1;
    return row.map((value, c) => (c < 4 ? sign * value : value));
  });
  const s = place - k;
  return at.map((b, c) => {
    const [a, d, e] = [before[c], next[c], after[c]];
    return b + (s / 2) * (d - a + s * (2 * a - 5 * b + 4 * d - e + s * (3 * (b - d) + e - a)));
  });
}

/** The camera of one of `about.paths` at a clip time; `phase` counts for loops. */
function cameraOf(about, path, time, phase) {
  if (path.rows) return cameraOnPath(path.rows, time);
  const place = Math.min(Math.max(time, 0), 1) * (path.offsets.length - 1);
  const k = Math.min(Math.floor(place), Math.max(path.offsets.length - 2, 0));
  const from = offsetAt(path.offsets[k], phase);
  const to = offsetAt(path.offsets[Math.min(k + 1, path.offsets.length - 1)], phase);
  return moved(cameraOnPath(about.clipPath, time), from.map((value, c) => value + (place - k) * (to[c] - value)));
}
