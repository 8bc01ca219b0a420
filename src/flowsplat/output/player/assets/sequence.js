// The page of several shots: each is a whole page of the player in a frame of its own, and when one has played to its end the next
// is shown. That one is unpacked meanwhile, so that there is no gap.

const pages = [...document.querySelectorAll("script.page")];
const data = [...document.querySelectorAll("script.data")];
const buttons = [...document.querySelectorAll("button[data-number]")];
const stage = document.getElementById("stage");
document.body.classList.toggle("embedded", location.hash === "#embed");
const inTurn = document.getElementById("in-turn");

/** The state of the player in a frame; nothing while it is being unpacked. */
const stateOf = (frame) => frame?.contentWindow?.flowsplat?.state;

function open(number) {
  const frame = document.createElement("iframe");
  frame.title = buttons[number].textContent;
  frame.className = "waiting";
  frame.allow = "fullscreen";
  frame.dataset.number = number;
  const [before, after] = JSON.parse(pages[number].textContent);
  frame.srcdoc = before + data[number].textContent + after;
  stage.append(frame);
  return frame;
}

const sequence = { number: -1, frame: null, next: null, before: 0 };
window.sequence = sequence;

function show(number) {
  const { frame, next } = sequence;
  const isReady = next && Number(next.dataset.number) === number;
  const shown = isReady ? next : open(number);
  if (!isReady) next?.remove();
  frame?.remove();
  shown.className = "";
  Object.assign(sequence, { number, frame: shown, next: null, before: 0 });
  const state = stateOf(shown);
  state?.setTime(0);
  state?.setPlaying(true);
  buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(k === number)));
}

function tick() {
  requestAnimationFrame(tick);
  const { number, frame, next, before } = sequence;
  const state = stateOf(frame);
  if (!state) return;
  const following = (number + 1) % pages.length;
  if (pages.length > 1 && !next) sequence.next = open(following);
  const waiting = stateOf(next);
  if (waiting?.isPlaying) {
    waiting.setPlaying(false);
    waiting.setTime(0);
  }
  const hasEnded = state.isPlaying && state.time < before;
  sequence.before = state.isPlaying ? state.time : 0;
  if (hasEnded && inTurn.checked && waiting) show(following);
}

buttons.forEach((button, k) => (button.onclick = () => show(k)));
show(0);
requestAnimationFrame(tick);
