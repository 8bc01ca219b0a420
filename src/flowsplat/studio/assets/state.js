// What the page knows, and who draws it. The server knows everything: what is shown is what it says, and what is done is asked of it.

export const now = {
  maxBytes: Infinity,
  project: null, // what the server says of the scene that is shown
  looks: null, // and of its clip as it is cut
  frame: 0, // the frame that is shown: its number, or "shot/number" of a clip with cuts
  tool: "new",
  object: 0, // which one clicks belong to
  scene: 0, // which of the shots that became scenes is shown, from 0
  selected: null, // {list, index}: a click that was clicked on
  suggested: null, // a place that the server suggests
  wanted: 0, // counts questions whose late answers are not wanted any more
};

const drawers = [];

// Calls a function whenever the server has said something new of the scene that is shown.
export function whenChanged(draw) {
  drawers.push(draw);
}

export function changed() {
  for (const draw of drawers) draw();
}
