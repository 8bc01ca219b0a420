// What moves: clicks on the frames of the clip, and what they mean.

import { $, make, replace, say, seconds, show } from "./page.js";
import { ask, attempt, save } from "./server.js";
import { now } from "./state.js";

const TOOLS = {
  new: "Click on something that moves. What is found lights up.",
  add: "Click on a part that did not light up.",
  away: "Click on what lights up but does not belong to it.",
  ground: "Click where it touches the ground: a foot, a wheel. One click is enough.",
};

function colorOf(index) {
  const colors = (now.looks && now.looks.colors) || ["#0b62c4"];
  return colors[index % colors.length];
}

export function chooseTool(name) {
  now.tool = name;
  for (const each of document.querySelectorAll("[data-tool]")) each.setAttribute("aria-pressed", String(each.dataset.tool === name));
  $("tool-says").textContent = TOOLS[name];
  if (now.project) drawMarks();
}

for (const each of document.querySelectorAll("[data-tool]")) each.addEventListener("click", () => chooseTool(each.dataset.tool));

export function showFrame(number) {
  now.frame = number;
  const at = now.looks.frames.findIndex(([each]) => each === number);
  $("frame-number").value = at;
  const [shot, own] = String(number).split("/"); // of a clip with cuts a frame is called shot/number
  const where = own === undefined ? "" : `, shot ${shot}`;
  $("frame-at").textContent = at < 0 ? "" : `${at + 1} of ${now.looks.frames.length}, at ${seconds(now.looks.frames[at][1])}${where}`;
  const { start, end, shots } = now.project.choices;
  show($("frame"), `/api/projects/${now.project.id}/frames/${number}?cut=${start}-${end}-${shots}`);
  now.selected = null;
  drawMarks();
  drawMasks();
}

let sliding = 0;
$("frame-number").addEventListener("input", () => {
  if (!now.looks) return;
  clearTimeout(sliding);
  sliding = setTimeout(() => showFrame(now.looks.frames[Number($("frame-number").value)][0]), 60);
});

$("frame").addEventListener("click", (event) => {
  if (!now.looks) return;
  const box = $("frame").getBoundingClientRect();
  const share = (value) => Math.min(Math.max(Number(value.toFixed(4)), 0), 1);
  const at = now.looks.frames.find(([number]) => number === now.frame);
  const mark = { x: share((event.clientX - box.left) / box.width), y: share((event.clientY - box.top) / box.height), frame: now.frame, second: at[1] };
  const choices = structuredClone(now.project.choices);
  if (now.tool === "ground") {
    choices.contacts.push(mark);
    now.suggested = null;
  } else if (now.tool === "new" || !choices.objects[now.object]) {
    choices.objects.push({ clicks: [mark], beside: [] });
    now.object = choices.objects.length - 1;
  } else choices.objects[now.object][now.tool === "add" ? "clicks" : "beside"].push(mark);
  if (now.tool === "new") chooseTool("add");
  change(choices);
});

async function change(choices) {
  now.selected = null;
  choices.objects = choices.objects.filter((each) => each.clicks.length || each.beside.length);
  now.object = Math.min(now.object, Math.max(choices.objects.length - 1, 0));
  const before = now.project.choices;
  now.project.choices = choices;
  drawMarks();
  if (await save("moves-error")) await drawMasks();
  else {
    now.project.choices = before;
    drawMarks();
  }
}

function eachMark() {
  const { objects, contacts } = now.project.choices, found = [];
  objects.forEach((each, number) => {
    each.clicks.forEach((mark, index) => found.push({ mark, index, number, list: "clicks", sign: String(number + 1) }));
    each.beside.forEach((mark, index) => found.push({ mark, index, number, list: "beside", sign: "−" }));
  });
  contacts.forEach((mark, index) => found.push({ mark, index, number: -1, list: "contacts", sign: "▼" }));
  return found;
}

function describeMark(each) {
  if (each.list === "contacts") return "touches the ground";
  return each.list === "clicks" ? `on object ${each.number + 1}` : `not object ${each.number + 1}`;
}

export function drawMarks() {
  if (!now.project || !now.looks) return;
  const shown = eachMark().filter((each) => each.mark.frame === now.frame).map((each) => {
    const button = make("button", {
      type: "button", "aria-label": `Click ${describeMark(each)}: choose it`, onclick: () => { now.selected = each; drawMarks(); },
    }, each.sign);
    button.style.left = `${100 * each.mark.x}%`;
    button.style.top = `${100 * each.mark.y}%`;
    button.style.background = each.list === "contacts" ? "#8a6d00" : each.list === "beside" ? "#222" : colorOf(each.number);
    button.classList.toggle("chosen", Boolean(now.selected && now.selected.list === each.list && now.selected.number === each.number && now.selected.index === each.index));
    return button;
  });
  if (now.suggested && now.suggested.frame === now.frame) {
    const ring = make("span", { class: "suggested" });
    ring.style.left = `${100 * now.suggested.x}%`;
    ring.style.top = `${100 * now.suggested.y}%`;
    shown.push(ring);
  }
  $("marks").replaceChildren(...shown);
  drawSelected();
  drawObjects();
}

function drawSelected() {
  const box = $("selected");
  box.hidden = !now.selected && !(now.suggested && now.suggested.frame === now.frame);
  if (box.hidden) return;
  if (!now.selected) {
    const { x, y } = now.suggested, second = (now.looks.frames.find(([number]) => number === now.frame) || [0, 0])[1];
    box.replaceChildren(make("p", {}, "Does it touch the ground inside the yellow ring? If not, click where it does, here or on another frame."),
      make("p", { class: "row" }, make("button", { type: "button", class: "main", onclick: () => {
        const choices = structuredClone(now.project.choices);
        choices.contacts.push({ x, y, frame: now.frame, second });
        now.suggested = null;
        change(choices);
      } }, "Yes, there"), make("button", { type: "button", onclick: () => { now.suggested = null; drawMarks(); } }, "It never does")));
    return;
  }
  const each = now.selected, others = [];
  const move = (to) => {
    const choices = structuredClone(now.project.choices);
    const [mark] = choices.objects[each.number][each.list].splice(each.index, 1);
    if (to < choices.objects.length) choices.objects[to][each.list].push(mark);
    else choices.objects.push({ clicks: [mark], beside: [] });
    change(choices);
  };
  if (each.list !== "contacts") {
    now.project.choices.objects.forEach((_, to) => {
      if (to !== each.number) others.push(make("button", { type: "button", onclick: () => move(to) }, `Give it to object ${to + 1}`));
    });
    if (each.list === "clicks" && now.project.choices.objects[each.number].clicks.length > 1) {
      others.push(make("button", { type: "button", onclick: () => move(Infinity) }, "Make it an object of its own"));
    }
  }
  box.replaceChildren(make("p", {}, `This click: ${describeMark(each)}.`), make("p", { class: "row" },
    make("button", { type: "button", class: "danger", onclick: () => {
      const choices = structuredClone(now.project.choices);
      (each.list === "contacts" ? choices.contacts : choices.objects[each.number][each.list]).splice(each.index, 1);
      change(choices);
    } }, "Remove it"), ...others, make("button", { type: "button", onclick: () => { now.selected = null; drawMarks(); } }, "Close")));
}

function drawObjects() {
  const { objects, contacts } = now.project.choices;
  const count = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;
  const rows = objects.map((each, number) => {
    const swatch = make("span", { class: "swatch" });
    swatch.style.background = colorOf(number);
    const buttons = [];
    if (objects.length > 1) buttons.push(make("button", { type: "button", "aria-pressed": String(number === now.object), onclick: () => { now.object = number; chooseTool("add"); } }, "Click on it"));
    if (number > 0) buttons.push(make("button", { type: "button", onclick: () => merge(number) }, `Same as object ${number}`));
    buttons.push(make("button", { type: "button", class: "danger", onclick: () => {
      const choices = structuredClone(now.project.choices);
      choices.objects.splice(number, 1);
      change(choices);
    } }, "Remove"));
    return make("li", {}, swatch, make("span", { class: "name" }, `Object ${number + 1}: ${count(each.clicks.length, "click")}`), ...buttons);
  });
  contacts.forEach((mark, index) => rows.push(make("li", {}, make("span", {}, "▼"),
    make("span", { class: "name" }, `Touches the ground at ${seconds(mark.second)}`),
    make("button", { type: "button", onclick: () => showFrame(mark.frame) }, "Show"),
    make("button", { type: "button", class: "danger", onclick: () => {
      const choices = structuredClone(now.project.choices);
      choices.contacts.splice(index, 1);
      change(choices);
    } }, "Remove"))));
  $("objects").replaceChildren(...rows);
  replace($("idle"), (now.project.idle || []).map((each) => make("li", {}, each)));
}

// Two objects that are one: the clicks of one go to the one before it.
function merge(number) {
  const choices = structuredClone(now.project.choices), { clicks, beside } = choices.objects[number];
  choices.objects[number - 1].clicks.push(...clicks);
  choices.objects[number - 1].beside.push(...beside);
  choices.objects.splice(number, 1);
  now.object = number - 1;
  change(choices);
}

let drawing = 0;

export async function drawMasks() {
  const mine = drawing += 1;
  const here = now.project.choices.objects.some((each) => each.clicks.some((mark) => mark.frame === now.frame));
  if (!here) {
    $("mask").hidden = $("busy").hidden = true;
    return;
  }
  $("busy").hidden = false;
  const found = await attempt("moves-error", () => ask("POST", `/api/projects/${now.project.id}/masks/${now.frame}`, {}));
  if (mine !== drawing) return;
  $("busy").hidden = true;
  $("mask").hidden = !found;
  if (!found) return;
  $("mask").src = found.image;
  const missed = now.project.choices.objects.findIndex((each, number) => each.clicks.some((mark) => mark.frame === now.frame) && found.shares[number] < 0.0002);
  if (missed >= 0) say("moves-error", `Nothing was found at the click on object ${missed + 1}: click on the middle of it, or on another frame.`);
}
