// The page of flowsplat studio: which part of it is shown, and what is asked again and again.

import { chooseTool } from "./clicks.js";
import { lookAt } from "./cut.js";
import { $, say, show } from "./page.js";
import { again, pause, setQuestion } from "./polling.js";
import "./scene.js";
import { ask } from "./server.js";
import { list } from "./start.js";
import { changed, now, whenChanged } from "./state.js";

async function route() {
  pause();
  now.wanted += 1;
  const id = location.hash.slice(1);
  now.project = now.looks = now.selected = now.suggested = null;
  for (const place of ["start-error", "scene-error", "cut-error", "moves-error", "go-error", "video-error", "export-error"]) say(place, "");
  $("start").hidden = Boolean(id);
  $("scene").hidden = true;
  window.scrollTo(0, 0);
  if (!id) return showStart();
  try {
    now.project = await ask("GET", `/api/projects/${encodeURIComponent(id)}`);
  } catch (error) {
    $("start").hidden = false;
    say("start-error", error.message);
    return showStart();
  }
  now.frame = 0;
  now.object = now.scene = 0;
  chooseTool("new");
  $("scene").hidden = false;
  $("sure").hidden = true;
  $("player-place").replaceChildren();
  $("videos").replaceChildren();
  $("frame").removeAttribute("src");
  $("no-video").hidden = true;
  $("video").hidden = false;
  show($("video"), now.project.clip);
  changed();
  await lookAt();
}

async function showStart() {
  const mine = now.wanted;
  await list();
  if (mine === now.wanted) again();
}

async function refresh() {
  const mine = now.wanted;
  try {
    if (now.project) {
      const found = await ask("GET", `/api/projects/${now.project.id}`);
      if (mine !== now.wanted || !now.project || found.id !== now.project.id) return;
      const choices = now.project.choices;
      now.project = found;
      now.project.choices = choices; // what is being clicked is newer
      changed();
    } else await list();
  } catch (error) { // a studio that does not answer was told of above
    if (mine === now.wanted && now.project && $("offline").hidden) say("scene-error", error.message);
  }
  if (mine === now.wanted) again();
}

whenChanged(again);
setQuestion(refresh);
window.addEventListener("hashchange", route);
route();
