// What came of a scene: it plays, its videos, its files.

import { chooseTool, showFrame } from "./clicks.js";
import { $, make, replace, say, size } from "./page.js";
import { act } from "./server.js";
import { now } from "./state.js";

const exportTo = (to) => act("export-error", "export", { to });

// Whether something is being made of the scene, or waits for its turn.
function isMaking(what) {
  return now.project.making === what || now.project.waiting.includes(what);
}

export function drawResults(results) {
  const making = isMaking("export html");
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
  say("share", results.page ? `One file of ${size(results.page_bytes)} that any browser plays without this studio: send it to a phone as you send a photo.` : "");
  say("orbit", results.orbit ? tellOrbit(results.orbit) : "");
  drawHints(results);
  drawVideos(results);
  drawExports(results);
}

function tellOrbit({ now: reached, before, guess }) {
  const guessed = guess === null ? "" : `; ${guess}% of what it shows there is a guess`;
  const last = before === null ? "" : before === reached ? " The last time it went as far." : ` The last time it went ${before}°.`;
  return `The orbit video goes ${reached}° to either side${guessed}.${last}`;
}

function drawHints(results) {
  // As soon as a click on the ground has come, the next step is to make the scene with it.
  const clicked = now.project.changed && now.project.choices.contacts.length > 0;
  if (clicked && results.hints.length) {
    return replace($("hints"), [make("div", { class: "hint" }, make("p", {}, "You have clicked where something touches the ground. That counts when the scene is made again."),
      make("p", { class: "row" }, make("button", { type: "button", class: "main", onclick: () => $("run").click() }, "Make it again")))]);
  }
  replace($("hints"), results.hints.map((hint) => make("div", { class: "hint" },
    make("p", {}, `How far away object ${hint.number} is, is a guess. One click where it touches the ground makes it sure.`),
    make("p", { class: "row" }, make("button", { type: "button", onclick: () => showHint(hint) }, "Show me where that may be")))));
}

function drawVideos(results) {
  replace($("videos"), results.videos.map((each) => make("figure", {},
    /\.gif(\?|$)/.test(each.link) ? make("img", { alt: each.title, src: each.link })
      : make("video", { controls: true, muted: true, loop: true, playsInline: true, preload: "metadata", src: each.link }),
    make("figcaption", {}, make("span", {}, each.title), make("a", { href: `${each.link}&download=1`, download: "" }, "Download")))));
  $("videos-box").hidden = !results.videos.length;
  replace($("renderings"), results.renderings.map((each) => {
    const busy = isMaking(`render ${each.name}`);
    return make("li", {}, make("span", { class: "about" }, each.title, make("small", {}, each.says)),
      make("button", { type: "button", disabled: busy, onclick: () => act("video-error", "render", { to: each.name }) }, busy ? "Being made ..." : "Make it"),
      make("code", {}, each.command));
  }));
  tellFailure("video-error", "render ");
}

function drawExports(results) {
  replace($("exports"), results.exports.filter((each) => each.name !== "html").map((each) => {
    const busy = isMaking(`export ${each.name}`);
    return make("li", {}, make("span", { class: "about" }, each.title, make("small", {}, each.says)),
      each.link ? make("a", { class: "button", href: each.link.startsWith("/files/") ? `${each.link}&download=1` : each.link, download: "" }, "Download")
        : make("button", { type: "button", disabled: busy, onclick: () => exportTo(each.name) }, busy ? "Being made ..." : "Make it"),
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
