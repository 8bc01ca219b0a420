// What came of a scene: it plays, its videos, its files.

import { chooseTool, showFrame } from "./clicks.js";
import { $, make, replace, say, size } from "./page.js";
import { act } from "./server.js";
import { changed, now } from "./state.js";

const exportTo = (to, shot = "") => act("export-error", "export", { to, shot });

// Whether something is being made of the scene, or waits for its turn.
function isMaking(what) {
  return now.project.making === what || now.project.waiting.includes(what);
}

export function drawResults(results) {
  const making = isMaking("export html");
  const place = $("player-place"), isShots = results.scenes[0].shot !== "";
  const scene = results.scenes[Math.min(now.scene, results.scenes.length - 1)];
  if (results.page) {
    const frameOf = place.querySelector("iframe");
    if (!frameOf || frameOf.getAttribute("src") !== results.page) {
      place.replaceChildren(make("iframe", { src: results.page, title: "The scene", allow: "fullscreen" }));
    }
  } else if (making && scene.videos.length) {
    if (!place.querySelector("video")) {
      place.replaceChildren(make("video", { autoplay: true, muted: true, loop: true, playsInline: true, src: scene.videos[0].link }));
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
  const found = make("a", { class: "button", href: scene.priors || "", target: "_blank", rel: "noopener" }, "What was found");
  if (scene.priors && !isShots) links.push(found);
  replace($("result-links"), links);
  drawScenes(results);
  replace($("scene-links"), isShots ? [make("a", { class: "button", href: scene.report, target: "_blank", rel: "noopener" }, "How good is this shot?"), ...(scene.priors ? [found] : [])] : []);
  say("share", results.page ? `One file of ${size(results.page_bytes)} that any browser plays without this studio: send it to a phone as you send a photo.` : "");
  say("orbit", scene.orbit ? tellOrbit(scene.orbit) : "");
  drawHints(scene);
  drawVideos(scene);
  drawExports(scene);
}

// Of a clip with cuts: its shots, of which one is looked at below.
function drawScenes(results) {
  $("scenes").hidden = results.scenes[0].shot === "";
  if ($("scenes").hidden) return;
  replace($("scenes"), results.scenes.map((each, index) => make("button", {
    type: "button", "aria-pressed": String(index === now.scene), onclick: () => { now.scene = index; changed(); },
  }, ...(each.frame === null ? [] : [make("img", { alt: "", src: `/api/projects/${now.project.id}/frames/${each.frame}` })]), each.title)));
}

function tellOrbit({ now: reached, before, guess }) {
  const guessed = guess === null ? "" : `; ${guess}% of what it shows there is a guess`;
  const last = before === null ? "" : before === reached ? " The last time it went as far." : ` The last time it went ${before}°.`;
  return `The orbit video goes ${reached}° to either side${guessed}.${last}`;
}

function drawHints(scene) {
  // As soon as a click on the ground has come, the next step is to make the scene with it.
  const clicked = now.project.changed && now.project.choices.contacts.length > 0;
  if (clicked && scene.hints.length) {
    return replace($("hints"), [make("div", { class: "hint" }, make("p", {}, "You have clicked where something touches the ground. That counts when the scene is made again."),
      make("p", { class: "row" }, make("button", { type: "button", class: "main", onclick: () => $("run").click() }, "Make it again")))]);
  }
  replace($("hints"), scene.hints.map((hint) => make("div", { class: "hint", "data-frame": String(hint.frame) },
    make("p", {}, `How far away object ${hint.number} is, is a guess. One click where it touches the ground makes it sure.`),
    make("p", { class: "row" }, make("button", { type: "button", onclick: () => showHint(hint) }, "Show me where that may be")))));
}

function drawVideos(scene) {
  replace($("videos"), scene.videos.map((each) => make("figure", {},
    /\.gif(\?|$)/.test(each.link) ? make("img", { alt: each.title, src: each.link })
      : make("video", { controls: true, muted: true, loop: true, playsInline: true, preload: "metadata", src: each.link }),
    make("figcaption", {}, make("span", {}, each.title), make("a", { href: `${each.link}&download=1`, download: "" }, "Download")))));
  $("videos-box").hidden = !scene.videos.length;
  replace($("renderings"), scene.renderings.map((each) => {
    const busy = isMaking(each.what);
    return make("li", {}, make("span", { class: "about" }, each.title, make("small", {}, each.says)),
      make("button", { type: "button", disabled: busy, onclick: () => act("video-error", "render", { to: each.name, shot: scene.shot }) }, busy ? "Being made ..." : "Make it"),
      make("code", {}, each.command));
  }));
  tellFailure("video-error", "render ");
}

function drawExports(scene) {
  replace($("exports"), scene.exports.filter((each) => each.name !== "html").map((each) => {
    const busy = isMaking(each.what);
    return make("li", {}, make("span", { class: "about" }, each.title, make("small", {}, each.says)),
      each.link ? make("a", { class: "button", href: each.link.startsWith("/files/") ? `${each.link}&download=1` : each.link, download: "" }, "Download")
        : make("button", { type: "button", disabled: busy, onclick: () => exportTo(each.name, scene.shot) }, busy ? "Being made ..." : "Make it"),
      make("code", {}, each.command));
  }));
  tellFailure("export-error", "export ");
}

function tellFailure(place, kind) {
  const { message, failed } = now.project;
  if (message && failed.startsWith(kind)) say(place, message);
}

function showHint(hint) {
  now.suggested = hint;
  chooseTool("ground");
  showFrame(hint.frame);
  $("moves").scrollIntoView({ behavior: "smooth" });
}
