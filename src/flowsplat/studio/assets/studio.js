"use strict";
// The page of flowsplat studio. The server knows everything: what is shown here is what it says, and what is done here is asked of it.

const $ = (id) => document.getElementById(id);
const TOOLS = {
  new: "Click on something that moves. What is found lights up.",
  add: "Click on a part that did not light up.",
  away: "Click on what lights up but does not belong to it.",
  ground: "Click where it touches the ground: a foot, a wheel. One click is enough.",
};
const PRESETS = {
  fast: ["Quick try", "Half size. Does this video work at all?"],
  default: ["Normal", "Full size, good quality."],
  high: ["Fine", "More detail. Takes long."],
  paper: ["As in the paper", "For researchers."],
};
const STATES = {
  draft: "not made yet", waiting: "waiting", running: "being made ...", stopping: "stopping ...", stopped: "stopped", failed: "did not work",
  done: "",
};
const SLOW = 4000, FAST = 1000; // milliseconds between two questions

let maxBytes = Infinity;
let project = null; // what the server says of the scene that is shown
let looks = null; // and of its clip as it is cut
let frame = 0; // the number of the frame that is shown
let tool = "new";
let object = 0; // which one clicks belong to
let selected = null; // {list, index}: a click that was clicked on
let suggested = null; // a place that the server suggests
let timer = 0;
let saving = Promise.resolve();
let wanted = 0; // counts questions whose late answers are not wanted any more

// -- asking

const pending = new Set(); // what was asked and not answered yet

function ask(method, path, body) {
  const asked = askNow(method, path, body).finally(() => pending.delete(asked));
  pending.add(asked);
  return asked;
}

async function askNow(method, path, body) {
  let answer;
  try {
    answer = await fetch(path, { method, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch {
    offline("The studio does not answer. Was it stopped? Start flowsplat studio again: this page goes on by itself.");
    throw new Error("The studio does not answer.");
  }
  const value = await answer.json().catch(() => ({ error: "The studio has said something that cannot be read." }));
  if (answer.status === 403) offline(value.error);
  else offline("");
  if (!answer.ok) throw new Error(value.error);
  return value;
}

function offline(text) {
  say("offline", text);
}

function say(id, text) {
  const place = $(id);
  place.textContent = text || "";
  place.hidden = !text;
}

// Runs what was asked for, and says beside it what went wrong.
async function attempt(place, what) {
  say(place, "");
  try {
    return await what();
  } catch (error) {
    say(place, error.message);
    return undefined;
  }
}

// -- small things

function make(kind, about = {}, ...inside) {
  const made = document.createElement(kind);
  for (const [name, value] of Object.entries(about)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "class") made.className = value;
    else if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...inside);
  return made;
}

function seconds(value) {
  return `${value.toFixed(2)} s`;
}

function about(value) {
  if (value < 90) return `about ${Math.max(5, Math.round(value / 5) * 5)} seconds`;
  if (value < 5400) return `about ${Math.round(value / 60)} minutes`;
  return `about ${(value / 3600).toFixed(1)} hours`;
}

function size(bytes) {
  return bytes < 1e9 ? `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB` : `${(bytes / 1e9).toFixed(1)} GB`;
}

// Sets an address only where it is another one: an image or a page would load anew.
function show(element, address) {
  if (address && element.getAttribute("src") !== address) element.setAttribute("src", address);
  if (!address) element.removeAttribute("src");
}

function colorOf(index) {
  const colors = (looks && looks.colors) || ["#0b62c4"];
  return colors[index % colors.length];
}

// -- where we are

async function route() {
  clearTimeout(timer);
  wanted += 1;
  const id = location.hash.slice(1);
  project = looks = selected = suggested = null;
  for (const place of ["start-error", "scene-error", "cut-error", "moves-error", "go-error", "export-error"]) say(place, "");
  $("start").hidden = Boolean(id);
  $("scene").hidden = true;
  window.scrollTo(0, 0);
  if (!id) return list();
  try {
    project = await ask("GET", `/api/projects/${encodeURIComponent(id)}`);
  } catch (error) {
    $("start").hidden = false;
    say("start-error", error.message);
    return list();
  }
  frame = 0;
  object = 0;
  chooseTool("new");
  $("scene").hidden = false;
  $("sure").hidden = true;
  $("player-place").replaceChildren();
  $("videos").replaceChildren();
  $("frame").removeAttribute("src");
  $("no-video").hidden = true;
  $("video").hidden = false;
  show($("video"), project.clip);
  draw();
  again();
  await lookAt();
}

function again() {
  clearTimeout(timer);
  const busy = project && (["running", "stopping", "waiting"].includes(project.state) || project.exporting || project.waiting.length);
  timer = setTimeout(refresh, busy ? FAST : SLOW);
}

async function refresh() {
  const mine = wanted;
  try {
    if (project) {
      const found = await ask("GET", `/api/projects/${project.id}`);
      if (mine !== wanted || !project || found.id !== project.id) return;
      const choices = project.choices;
      project = found;
      project.choices = choices; // what is being clicked is newer
      draw();
    } else await list(true);
  } catch { /* it was said */ }
  if (mine === wanted) again();
}

// -- all scenes, and a new one

async function list(quiet) {
  const mine = wanted;
  try {
    const found = await ask("GET", "/api/projects");
    if (mine !== wanted) return;
    maxBytes = found.max_bytes;
    $("earlier").hidden = !found.projects.length;
    $("list").replaceChildren(...found.projects.map((each) => make("li", {}, make("a", { href: `#${each.id}` },
      make("img", { class: "thumb", alt: "", src: each.poster || "data:," }), make("b", {}, each.name),
      make("small", {}, [PRESETS[each.preset][0], STATES[each.state]].filter(Boolean).join(", "))))));
  } catch { /* it was said */ }
  if (!quiet && mine === wanted) again();
}

let sender = null;

function send(file) {
  say("start-error", "");
  if (sender) return say("start-error", "Another video is on its way: wait until it has arrived.");
  if (file.size > maxBytes) return say("start-error", `This video has ${size(file.size)}; at most ${size(maxBytes)} are taken. Cut it first.`);
  if (file.size === 0) return say("start-error", `${file.name} is empty.`);
  const seen = URL.createObjectURL(file);
  $("sent-video").hidden = false;
  $("sent-video").src = seen;
  $("sent-video").onerror = () => { $("sent-video").hidden = true; };
  $("sent-video").onloadeddata = () => { $("sent-video").play().catch(() => {}); };
  $("drop").hidden = true;
  $("sending").hidden = false;
  $("sent").value = 0;
  $("sent-text").textContent = `Sending ${file.name} ...`;
  sender = new XMLHttpRequest();
  sender.open("PUT", `/api/clips?name=${encodeURIComponent(file.name)}`);
  sender.upload.onprogress = (event) => {
    $("sent").value = event.loaded / Math.max(event.total, 1);
    $("sent-text").textContent = event.loaded < event.total ? `${size(event.loaded)} of ${size(event.total)}` : "Looking at it ...";
    if (event.loaded >= event.total) $("sent").removeAttribute("value");
  };
  const end = (text) => {
    sender = null;
    $("drop").hidden = false;
    $("sending").hidden = true;
    $("sent-video").removeAttribute("src");
    URL.revokeObjectURL(seen);
    $("file").value = "";
    say("start-error", text);
  };
  sender.onload = () => {
    let value = {};
    try { value = JSON.parse(sender.responseText); } catch { /* said below */ }
    if (sender.status === 201) {
      end("");
      location.hash = value.id;
    } else end(value.error || "The video was not taken.");
  };
  sender.onerror = () => end("The video did not arrive: the studio has closed the connection. Is it still running?");
  sender.onabort = () => end("");
  sender.send(file);
}

$("file").addEventListener("change", () => { if ($("file").files[0]) send($("file").files[0]); });
$("give-up").addEventListener("click", () => { if (sender) sender.abort(); });
$("drop").addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); $("file").click(); } });
for (const kind of ["dragenter", "dragover"]) {
  document.addEventListener(kind, (event) => { event.preventDefault(); $("drop").classList.add("over"); });
}
document.addEventListener("dragleave", () => $("drop").classList.remove("over"));
document.addEventListener("drop", (event) => {
  event.preventDefault();
  $("drop").classList.remove("over");
  const files = event.dataTransfer ? event.dataTransfer.files : [];
  if (files.length > 1) say("start-error", "Drop one video at a time.");
  else if (files.length && !$("start").hidden) send(files[0]);
});

// -- one scene

function draw() {
  const { state } = project;
  $("name").textContent = project.name;
  const results = state === "done" ? project.results : null;
  const fixed = project.fixed || ["running", "stopping", "waiting"].includes(state);
  $("cut").hidden = $("quality").hidden = fixed;
  $("moves").hidden = ["running", "stopping", "waiting"].includes(state);
  $("go").hidden = ["running", "stopping", "waiting"].includes(state) || (fixed && !project.changed && state === "done");
  $("moves").querySelector("h2").firstChild.textContent = fixed ? "Click on what moves " : "3. Click on what moves ";
  $("go-title").textContent = fixed ? (project.changed ? "Make it again with these clicks" : "Go on") : "4. Make the scene";
  $("run").textContent = fixed ? "Go on" : "Make the scene";
  $("command").textContent = project.command;
  if (looks) {
    const estimate = looks.estimates[project.choices.preset];
    $("run-time").textContent = fixed ? "" : `takes ${estimate.says}`;
  }
  drawProgress();
  $("result").hidden = !results;
  if (results) drawResults(results);
}

function drawProgress() {
  const { state, standing } = project;
  const box = $("progress");
  box.hidden = state === "draft" || state === "done";
  if (box.hidden) return;
  const working = state === "running" || state === "stopping";
  $("progress-title").textContent = state === "waiting" ? "It begins when the scene before it is ready" : state === "stopping"
    ? "Stopping: what is done so far is kept" : working && standing ? standing.says : state === "failed" ? "It did not work" : "Stopped";
  const image = project.preview || project.poster;
  $("preview").hidden = !image;
  if (image) show($("preview"), image);
  $("preview-says").hidden = !project.preview;
  $("bar").hidden = !working;
  if (standing && standing.share !== null) $("bar").value = standing.share;
  else $("bar").removeAttribute("value");
  $("left").textContent = !working || !standing ? "" : standing.left !== null ? `${about(standing.left)} left`
    : standing.late ? "This takes longer than expected." : "";
  $("left").hidden = !$("left").textContent;
  $("line").textContent = working && standing ? standing.line : "";
  $("stop").hidden = !(state === "running" || state === "waiting");
  $("stop").textContent = state === "waiting" ? "Do not begin" : "Stop";
  $("resume").hidden = !(state === "stopped" || state === "failed");
  $("resume").textContent = state === "failed" ? "Try again" : "Go on";
  $("goes-on").hidden = !(working || state === "waiting");
  say("scene-error", state === "failed" ? project.message : "");
}

function drawResults(results) {
  const making = project.exporting === "html" || project.waiting.includes("export html");
  const place = $("player-place");
  if (results.page) {
    const frameOf = place.querySelector("iframe");
    if (!frameOf || frameOf.getAttribute("src") !== results.page) {
      place.replaceChildren(make("iframe", { src: results.page, title: "The scene", allow: "fullscreen" }));
    }
  } else if (making && results.videos.length) {
    if (!place.querySelector("video")) {
      place.replaceChildren(make("video", { autoplay: true, muted: true, loop: true, playsInline: true, src: results.videos[0].link }));
    }
  } else place.replaceChildren();
  say("player-wait", results.page ? "" : making ? "The page that plays it is being made ..." : "");
  const links = [];
  if (results.page) {
    links.push(make("a", { class: "button main", href: `${results.page}&download=1`, download: "" }, "Download it"));
    links.push(make("a", { class: "button", href: results.page, target: "_blank", rel: "noopener" }, "Open it large"));
  } else if (!making) {
    links.push(make("button", { type: "button", class: "main", onclick: () => exportTo("html") }, "Make the page that plays it"));
  }
  links.push(make("a", { class: "button", href: results.report, target: "_blank", rel: "noopener" }, "How good is it?"));
  if (results.priors) links.push(make("a", { class: "button", href: results.priors, target: "_blank", rel: "noopener" }, "What was found"));
  replace($("result-links"), links);
  const { orbit } = results;
  say("orbit", orbit ? `The camera can go ${orbit.now}° to either side before it shows guesses${orbit.before === null ? ""
    : orbit.before === orbit.now ? ", as the last time" : `; the last time it was ${orbit.before}°`}.` : "");
  replace($("hints"), results.hints.map((hint) => make("div", { class: "hint" },
    make("p", {}, `How far away object ${hint.number} is, is a guess. One click where it touches the ground makes it sure.`),
    make("p", { class: "row" }, make("button", { type: "button", onclick: () => showHint(hint) }, "Show me where that may be")))));
  replace($("videos"), results.videos.map((each) => make("figure", {},
    /\.gif(\?|$)/.test(each.link) ? make("img", { alt: each.title, src: each.link })
      : make("video", { controls: true, muted: true, loop: true, playsInline: true, preload: "metadata", src: each.link }),
    make("figcaption", {}, make("span", {}, each.title), make("a", { href: `${each.link}&download=1`, download: "" }, "Download")))));
  $("videos-box").hidden = !results.videos.length;
  replace($("exports"), results.exports.filter((each) => each.name !== "html").map((each) => {
    const busy = project.exporting === each.name || project.waiting.includes(`export ${each.name}`);
    return make("li", {}, make("span", { class: "about" }, each.title, make("small", {}, each.says)),
      each.link ? make("a", { class: "button", href: each.link.startsWith("/files/") ? `${each.link}&download=1` : each.link, download: "" }, "Download")
        : make("button", { type: "button", disabled: busy, onclick: () => exportTo(each.name) }, busy ? "Being made ..." : "Make it"),
      make("code", {}, each.command));
  }));
  say("export-error", project.message && project.failed !== "run" ? project.message : "");
}

// Puts in what is new: what is the same stays, so that a video plays on.
function replace(place, inside) {
  const text = inside.map((each) => each.outerHTML).join("\n");
  if (place.dataset.shown === text && place.childElementCount === inside.length) return;
  place.dataset.shown = text;
  place.replaceChildren(...inside);
}

function showHint(hint) {
  suggested = hint;
  chooseTool("ground");
  showFrame(hint.frame);
  $("moves").scrollIntoView({ behavior: "smooth" });
}

async function act(place, action, body) {
  return attempt(place, async () => {
    await saving;
    const found = await ask("POST", `/api/projects/${project.id}/${action}`, body);
    if (action === "copy") location.hash = found.id;
    else {
      project = found;
      draw();
      again();
    }
  });
}

const exportTo = (to) => act("export-error", "export", { to });

$("run").addEventListener("click", () => begin("go-error"));
$("resume").addEventListener("click", () => begin("scene-error"));
$("stop").addEventListener("click", () => act("scene-error", "stop"));
$("again").addEventListener("click", () => act("scene-error", "copy"));
$("delete").addEventListener("click", () => { $("sure").hidden = false; });
$("keep").addEventListener("click", () => { $("sure").hidden = true; });
$("really").addEventListener("click", async () => {
  clearTimeout(timer);
  wanted += 1;
  await Promise.allSettled([...pending]); // nothing is asked about what is gone
  const gone = await attempt("scene-error", () => ask("DELETE", `/api/projects/${project.id}`));
  if (gone) location.hash = "";
  else again();
});
$("copy-command").addEventListener("click", async () => {
  try {
    await navigator.clipboard.writeText(project.command);
    $("copy-command").textContent = "Copied";
  } catch {
    getSelection().selectAllChildren($("command"));
    $("copy-command").textContent = "Press Ctrl+C";
  }
  setTimeout(() => { $("copy-command").textContent = "Copy it"; }, 2000);
});

async function begin(place) {
  $("run").disabled = $("resume").disabled = true;
  await act(place, "run");
  $("run").disabled = $("resume").disabled = false;
  if (project && project.state !== "draft") window.scrollTo({ top: 0, behavior: "smooth" });
}

// -- the cut, and how well

// Saves what is chosen, one after the other; resolves when this is saved.
function save(place) {
  const { id, choices } = project;
  const body = structuredClone(choices);
  saving = saving.catch(() => {}).then(() => attempt(place, async () => {
    const found = await ask("PUT", `/api/projects/${id}/choices`, body);
    if (project && project.id === id) {
      project.command = found.command;
      project.changed = found.changed;
      draw();
    }
    return true;
  }));
  return saving;
}

async function lookAt() {
  const mine = wanted, { id } = project;
  const found = await attempt("cut-error", () => ask("GET", `/api/projects/${id}/look`));
  if (!found || mine !== wanted) return;
  looks = found;
  project.choices = found.choices;
  if (found.lost) say("moves-error", `${found.lost} of your clicks were on frames that the cut leaves out now: they are gone.`);
  replace($("notes"), found.notes.map((note) => make("li", {}, note)));
  drawCut();
  drawPresets();
  const numbers = found.frames.map(([number]) => number);
  $("frame-number").max = numbers.length - 1;
  if (!numbers.includes(frame) || !$("frame").getAttribute("src")) frame = firstShown(numbers);
  draw();
  showFrame(frame);
}

// The first frame with a click, or the first of all.
function firstShown(numbers) {
  const { objects, contacts } = project.choices;
  const clicked = [...objects.flatMap((each) => each.clicks), ...contacts].map((mark) => mark.frame);
  return clicked.find((number) => numbers.includes(number)) ?? numbers[0];
}

function drawCut() {
  const { start, end } = project.choices, whole = looks.duration;
  for (const id of ["cut-start", "cut-end"]) $(id).max = whole;
  $("cut-start").value = start ?? 0;
  $("cut-end").value = end ?? whole;
  tellCut();
}

function tellCut() {
  const from = Number($("cut-start").value), to = Number($("cut-end").value);
  $("start-at").textContent = seconds(from);
  $("end-at").textContent = seconds(to);
  const used = looks ? `, ${looks.num_frames} frames are used` : "";
  $("cut-length").textContent = `${seconds(Math.max(to - from, 0))} of ${seconds(looks.duration)}${used}`;
}

function moveCut(id) {
  if (!looks) return;
  const least = Math.min(0.2, looks.duration / 4);
  let from = Number($("cut-start").value), to = Number($("cut-end").value);
  if (to - from < least) {
    if (id === "cut-start") from = Math.max(0, to - least);
    else to = Math.min(looks.duration, from + least);
    $("cut-start").value = from;
    $("cut-end").value = to;
  }
  const video = $("video");
  video.pause();
  if (Number.isFinite(video.duration)) video.currentTime = Math.min(id === "cut-start" ? from : to, video.duration);
  tellCut();
}

async function keepCut() {
  if (!looks) return;
  const from = Number($("cut-start").value), to = Number($("cut-end").value), before = project.choices;
  project.choices = {
    ...before, start: from > 0.005 ? Number(from.toFixed(3)) : null, end: to < looks.duration - 0.005 ? Number(to.toFixed(3)) : null,
  };
  $("cut-length").textContent = "Looking ...";
  if (await save("cut-error")) await lookAt();
  else {
    project.choices = before;
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
  if (!video.paused && looks && video.currentTime > Number($("cut-end").value)) video.pause();
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
    make("small", {}, text), make("small", { class: "time" }, looks.estimates[name].says))));
  for (const input of $("presets").querySelectorAll("input")) input.checked = input.value === project.choices.preset;
}

async function choosePreset(name) {
  project.choices = { ...project.choices, preset: name };
  draw();
  if (await save("cut-error")) await drawMasks();
}

// -- what moves

function chooseTool(name) {
  tool = name;
  for (const each of document.querySelectorAll("[data-tool]")) each.setAttribute("aria-pressed", String(each.dataset.tool === name));
  $("tool-says").textContent = TOOLS[name];
  if (project) drawMarks();
}

for (const each of document.querySelectorAll("[data-tool]")) each.addEventListener("click", () => chooseTool(each.dataset.tool));

function showFrame(number) {
  frame = number;
  const at = looks.frames.findIndex(([each]) => each === number);
  $("frame-number").value = at;
  $("frame-at").textContent = at < 0 ? "" : `${at + 1} of ${looks.frames.length}, at ${seconds(looks.frames[at][1])}`;
  const { start, end } = project.choices;
  show($("frame"), `/api/projects/${project.id}/frames/${number}?cut=${start}-${end}`);
  selected = null;
  drawMarks();
  drawMasks();
}

let sliding = 0;
$("frame-number").addEventListener("input", () => {
  if (!looks) return;
  clearTimeout(sliding);
  sliding = setTimeout(() => showFrame(looks.frames[Number($("frame-number").value)][0]), 60);
});

$("frame").addEventListener("click", (event) => {
  if (!looks) return;
  const box = $("frame").getBoundingClientRect();
  const share = (value) => Math.min(Math.max(Number(value.toFixed(4)), 0), 1);
  const at = looks.frames.find(([number]) => number === frame);
  const mark = { x: share((event.clientX - box.left) / box.width), y: share((event.clientY - box.top) / box.height), frame, second: at[1] };
  const choices = structuredClone(project.choices);
  if (tool === "ground") {
    choices.contacts.push(mark);
    suggested = null;
  } else if (tool === "new" || !choices.objects[object]) {
    choices.objects.push({ clicks: [mark], beside: [] });
    object = choices.objects.length - 1;
  } else choices.objects[object][tool === "add" ? "clicks" : "beside"].push(mark);
  if (tool === "new") chooseTool("add");
  change(choices);
});

async function change(choices) {
  selected = null;
  choices.objects = choices.objects.filter((each) => each.clicks.length || each.beside.length);
  object = Math.min(object, Math.max(choices.objects.length - 1, 0));
  const before = project.choices;
  project.choices = choices;
  drawMarks();
  if (await save("moves-error")) await drawMasks();
  else {
    project.choices = before;
    drawMarks();
  }
}

function eachMark() {
  const { objects, contacts } = project.choices, found = [];
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

function drawMarks() {
  if (!project || !looks) return;
  const shown = eachMark().filter((each) => each.mark.frame === frame).map((each) => {
    const button = make("button", {
      type: "button", "aria-label": `Click ${describeMark(each)}: choose it`, onclick: () => { selected = each; drawMarks(); },
    }, each.sign);
    button.style.left = `${100 * each.mark.x}%`;
    button.style.top = `${100 * each.mark.y}%`;
    button.style.background = each.list === "contacts" ? "#8a6d00" : each.list === "beside" ? "#222" : colorOf(each.number);
    button.classList.toggle("chosen", Boolean(selected && selected.list === each.list && selected.number === each.number && selected.index === each.index));
    return button;
  });
  if (suggested && suggested.frame === frame) {
    const ring = make("span", { class: "suggested" });
    ring.style.left = `${100 * suggested.x}%`;
    ring.style.top = `${100 * suggested.y}%`;
    shown.push(ring);
  }
  $("marks").replaceChildren(...shown);
  drawSelected();
  drawObjects();
}

function drawSelected() {
  const box = $("selected");
  box.hidden = !selected && !(suggested && suggested.frame === frame);
  if (box.hidden) return;
  if (!selected) {
    const { x, y } = suggested, second = (looks.frames.find(([number]) => number === frame) || [0, 0])[1];
    box.replaceChildren(make("p", {}, "Does it touch the ground inside the yellow ring? If not, click where it does, here or on another frame."),
      make("p", { class: "row" }, make("button", { type: "button", class: "main", onclick: () => {
        const choices = structuredClone(project.choices);
        choices.contacts.push({ x, y, frame, second });
        suggested = null;
        change(choices);
      } }, "Yes, there"), make("button", { type: "button", onclick: () => { suggested = null; drawMarks(); } }, "It never does")));
    return;
  }
  const each = selected, others = [];
  const move = (to) => {
    const choices = structuredClone(project.choices);
    const [mark] = choices.objects[each.number][each.list].splice(each.index, 1);
    if (to < choices.objects.length) choices.objects[to][each.list].push(mark);
    else choices.objects.push({ clicks: [mark], beside: [] });
    change(choices);
  };
  if (each.list !== "contacts") {
    project.choices.objects.forEach((_, to) => {
      if (to !== each.number) others.push(make("button", { type: "button", onclick: () => move(to) }, `Give it to object ${to + 1}`));
    });
    if (each.list === "clicks" && project.choices.objects[each.number].clicks.length > 1) {
      others.push(make("button", { type: "button", onclick: () => move(Infinity) }, "Make it an object of its own"));
    }
  }
  box.replaceChildren(make("p", {}, `This click: ${describeMark(each)}.`), make("p", { class: "row" },
    make("button", { type: "button", class: "danger", onclick: () => {
      const choices = structuredClone(project.choices);
      (each.list === "contacts" ? choices.contacts : choices.objects[each.number][each.list]).splice(each.index, 1);
      change(choices);
    } }, "Remove it"), ...others, make("button", { type: "button", onclick: () => { selected = null; drawMarks(); } }, "Close")));
}

function drawObjects() {
  const { objects, contacts } = project.choices;
  const count = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;
  const rows = objects.map((each, number) => {
    const swatch = make("span", { class: "swatch" });
    swatch.style.background = colorOf(number);
    const buttons = [];
    if (objects.length > 1) buttons.push(make("button", { type: "button", "aria-pressed": String(number === object), onclick: () => { object = number; chooseTool("add"); } }, "Click on it"));
    if (number > 0) buttons.push(make("button", { type: "button", onclick: () => merge(number) }, `Same as object ${number}`));
    buttons.push(make("button", { type: "button", class: "danger", onclick: () => {
      const choices = structuredClone(project.choices);
      choices.objects.splice(number, 1);
      change(choices);
    } }, "Remove"));
    return make("li", {}, swatch, make("span", { class: "name" }, `Object ${number + 1}: ${count(each.clicks.length, "click")}`), ...buttons);
  });
  contacts.forEach((mark, index) => rows.push(make("li", {}, make("span", {}, "▼"),
    make("span", { class: "name" }, `Touches the ground at ${seconds(mark.second)}`),
    make("button", { type: "button", onclick: () => showFrame(mark.frame) }, "Show"),
    make("button", { type: "button", class: "danger", onclick: () => {
      const choices = structuredClone(project.choices);
      choices.contacts.splice(index, 1);
      change(choices);
    } }, "Remove"))));
  $("objects").replaceChildren(...rows);
}

// Two objects that are one: the clicks of one go to the one before it.
function merge(number) {
  const choices = structuredClone(project.choices), { clicks, beside } = choices.objects[number];
  choices.objects[number - 1].clicks.push(...clicks);
  choices.objects[number - 1].beside.push(...beside);
  choices.objects.splice(number, 1);
  object = number - 1;
  change(choices);
}

let drawing = 0;

async function drawMasks() {
  const mine = drawing += 1;
  const here = project.choices.objects.some((each) => each.clicks.some((mark) => mark.frame === frame));
  if (!here) {
    $("mask").hidden = $("busy").hidden = true;
    return;
  }
  $("busy").hidden = false;
  const found = await attempt("moves-error", () => ask("POST", `/api/projects/${project.id}/masks/${frame}`, {}));
  if (mine !== drawing) return;
  $("busy").hidden = true;
  $("mask").hidden = !found;
  if (!found) return;
  $("mask").src = found.image;
  const missed = project.choices.objects.findIndex((each, number) => each.clicks.some((mark) => mark.frame === frame) && found.shares[number] < 0.0002);
  if (missed >= 0) say("moves-error", `Nothing was found at the click on object ${missed + 1}: click on the middle of it, or on another frame.`);
}

window.addEventListener("hashchange", route);
route();
