// The cut, and how well the scene is made.

import { drawMasks, showFrame } from "./clicks.js";
import { $, make, replace, say, seconds } from "./page.js";
import { ask, attempt, save } from "./server.js";
import { changed, now } from "./state.js";

export const PRESETS = {
  fast: ["Quick try", "Half size. Does this video work at all?"],
  default: ["Normal", "Full size, good quality."],
  high: ["Fine", "More detail. Takes long."],
  paper: ["As in the paper", "For researchers."],
};

export async function lookAt() {
  const mine = now.wanted, { id } = now.project;
  const found = await attempt("cut-error", () => ask("GET", `/api/projects/${id}/look`));
  if (!found || mine !== now.wanted) return;
  now.looks = found;
  now.project.choices = found.choices;
  if (found.lost) say("moves-error", `${found.lost} of your clicks were on frames that the cut leaves out now: they are gone.`);
  replace($("notes"), found.notes.map((note) => make("li", {}, note)));
  drawCut();
  drawShots();
  drawPresets();
  const numbers = found.frames.map(([number]) => number);
  $("frame-number").max = numbers.length - 1;
  if (!numbers.includes(now.frame) || !$("frame").getAttribute("src")) now.frame = firstShown(numbers);
  changed();
  showFrame(now.frame);
}

// The first frame with a click, or the first of all.
function firstShown(numbers) {
  const { objects, contacts } = now.project.choices;
  const clicked = [...objects.flatMap((each) => each.clicks), ...contacts].map((mark) => mark.frame);
  return clicked.find((number) => numbers.includes(number)) ?? numbers[0];
}

function drawCut() {
  const { start, end } = now.project.choices, whole = now.looks.duration;
  for (const id of ["cut-start", "cut-end"]) $(id).max = whole;
  $("cut-start").value = start ?? 0;
  $("cut-end").value = end ?? whole;
  tellCut();
}

function tellCut() {
  const from = Number($("cut-start").value), to = Number($("cut-end").value);
  $("start-at").textContent = seconds(from);
  $("end-at").textContent = seconds(to);
  const used = now.looks ? `, ${now.looks.num_frames} frames are used` : "";
  $("cut-length").textContent = `${seconds(Math.max(to - from, 0))} of ${seconds(now.looks.duration)}${used}`;
}

function moveCut(id) {
  if (!now.looks) return;
  const least = Math.min(0.2, now.looks.duration / 4);
  let from = Number($("cut-start").value), to = Number($("cut-end").value);
  if (to - from < least) {
    if (id === "cut-start") from = Math.max(0, to - least);
    else to = Math.min(now.looks.duration, from + least);
    $("cut-start").value = from;
    $("cut-end").value = to;
  }
  const video = $("video");
  video.pause();
  if (Number.isFinite(video.duration)) video.currentTime = Math.min(id === "cut-start" ? from : to, video.duration);
  tellCut();
}

async function keepCut() {
  if (!now.looks) return;
  const from = Number($("cut-start").value), to = Number($("cut-end").value), before = now.project.choices;
  now.project.choices = {
    ...before, start: from > 0.005 ? Number(from.toFixed(3)) : null, end: to < now.looks.duration - 0.005 ? Number(to.toFixed(3)) : null,
  };
  $("cut-length").textContent = "Looking ...";
  if (await save("cut-error")) await lookAt();
  else {
    now.project.choices = before;
    drawCut();
  }
}

for (const id of ["cut-start", "cut-end"]) {
  $(id).addEventListener("input", () => moveCut(id));
  $(id).addEventListener("change", keepCut);
}
$("play-cut").addEventListener("click", () => {
  const video = $("video");
  video.currentTime = Number($("cut-start").value);
  video.play().catch(() => {});
});
$("video").addEventListener("timeupdate", () => {
  const video = $("video");
  if (!video.paused && now.looks && video.currentTime > Number($("cut-end").value)) video.pause();
});
$("video").addEventListener("error", () => {
  if ($("video").getAttribute("src")) {
    $("video").hidden = true;
    $("no-video").hidden = false;
  }
});

function drawPresets() {
  replace($("presets"), Object.entries(PRESETS).map(([name, [title, text]]) => make("label", {},
    make("input", { type: "radio", name: "preset", value: name, onchange: () => choosePreset(name) }), make("b", {}, title),
    make("small", {}, text), make("small", { class: "time" }, now.looks.estimates[name].says))));
  for (const input of $("presets").querySelectorAll("input")) input.checked = input.value === now.project.choices.preset;
}

// Of a clip with cuts: whether each shot becomes a scene, or all of it one.
function drawShots() {
  const { shots, has_cuts: hasCuts } = now.looks, count = shots || "some";
  $("shots").hidden = !hasCuts;
  const kinds = {
    split: ["Each shot a scene", shots ? `${count} scene${shots === 1 ? "" : "s"}, and one page that plays ${shots === 1 ? "it" : "them in turn"}.` : "As many scenes as there are shots."],
    off: ["All of it one scene", "Only where one place is seen all the time."],
  };
  replace($("shots"), Object.entries(kinds).map(([kind, [title, text]]) => make("label", {},
    make("input", { type: "radio", name: "shots", value: kind, onchange: () => chooseShots(kind) }), make("b", {}, title), make("small", {}, text))));
  for (const input of $("shots").querySelectorAll("input")) input.checked = input.value === now.project.choices.shots;
}

async function chooseShots(kind) {
  now.project.choices = { ...now.project.choices, shots: kind };
  if (await save("cut-error")) await lookAt();
}

async function choosePreset(name) {
  now.project.choices = { ...now.project.choices, preset: name };
  changed();
  if (await save("cut-error")) await drawMasks();
}
