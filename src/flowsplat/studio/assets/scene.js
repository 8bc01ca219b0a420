// One scene: how far it is, and what can be done with it.

import { $, about, say, show } from "./page.js";
import { again, pause } from "./polling.js";
import { drawResults } from "./results.js";
import { act, ask, attempt, pending } from "./server.js";
import { now, whenChanged } from "./state.js";

function draw() {
  const { state } = now.project;
  $("name").textContent = now.project.name;
  const results = state === "done" ? now.project.results : null;
  const fixed = now.project.fixed || ["running", "stopping", "waiting"].includes(state);
  $("cut").hidden = $("quality").hidden = fixed;
  $("moves").hidden = ["running", "stopping", "waiting"].includes(state);
  $("go").hidden = ["running", "stopping", "waiting"].includes(state) || (fixed && !now.project.changed && state === "done");
  $("moves").querySelector("h2").firstChild.textContent = fixed ? "Click on what moves " : "3. Click on what moves ";
  $("go-title").textContent = fixed ? (now.project.changed ? "Make it again with these clicks" : "Go on") : "4. Make the scene";
  $("run").textContent = !fixed ? "Make the scene" : now.project.changed ? "Make it again" : "Go on";
  $("command").textContent = now.project.command;
  if (now.looks) {
    const estimate = now.looks.estimates[now.project.choices.preset];
    $("run-time").textContent = fixed ? "what the clicks do not change is kept" : `takes ${estimate.says}`;
  }
  drawProgress();
  $("result").hidden = !results;
  if (results) drawResults(results);
}

function drawProgress() {
  const { state, standing } = now.project;
  const box = $("progress");
  box.hidden = state === "draft" || state === "done";
  if (box.hidden) return;
  const working = state === "running" || state === "stopping";
  $("progress-title").textContent = state === "waiting" ? "It begins when the scene before it is ready" : state === "stopping"
    ? "Stopping: what is done so far is kept" : working && standing ? standing.says : state === "failed" ? "It did not work" : "Stopped";
  const image = now.project.preview || now.project.poster;
  $("preview").hidden = !image;
  if (image) show($("preview"), image);
  $("preview-says").hidden = !now.project.preview;
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
  say("scene-error", state === "failed" ? now.project.message : "");
}

whenChanged(draw);

$("run").addEventListener("click", () => begin("go-error"));
$("resume").addEventListener("click", () => begin("scene-error"));
$("stop").addEventListener("click", () => act("scene-error", "stop"));
$("again").addEventListener("click", () => act("scene-error", "copy"));
$("delete").addEventListener("click", () => { $("sure").hidden = false; });
$("keep").addEventListener("click", () => { $("sure").hidden = true; });
$("really").addEventListener("click", async () => {
  pause();
  now.wanted += 1;
  await Promise.allSettled([...pending]); // nothing is asked about what is gone
  const gone = await attempt("scene-error", () => ask("DELETE", `/api/projects/${now.project.id}`));
  if (gone) location.hash = "";
  else again();
});
$("copy-command").addEventListener("click", async () => {
  try {
    await navigator.clipboard.writeText(now.project.command);
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
  if (now.project && now.project.state !== "draft") window.scrollTo({ top: 0, behavior: "smooth" });
}
