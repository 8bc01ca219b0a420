// All scenes, and a new one.

import { PRESETS } from "./cut.js";
import { $, make, say, size } from "./page.js";
import { ask } from "./server.js";
import { now } from "./state.js";

const STATES = {
  draft: "not made yet", waiting: "waiting", running: "being made ...", stopping: "stopping ...", stopped: "stopped", failed: "did not work",
  done: "",
};

export async function list() {
  const mine = now.wanted;
  try {
    const found = await ask("GET", "/api/projects");
    if (mine !== now.wanted) return;
    now.maxBytes = found.max_bytes;
    $("earlier").hidden = !found.projects.length;
    $("list").replaceChildren(...found.projects.map((each) => make("li", {}, make("a", { href: `#${each.id}` },
      make("img", { class: "thumb", alt: "", src: each.poster || "data:," }), make("b", {}, each.name),
      make("small", {}, [PRESETS[each.preset][0], STATES[each.state]].filter(Boolean).join(", "))))));
  } catch { /* it was said */ }
}

let sender = null;

function send(file) {
  say("start-error", "");
  if (sender) return say("start-error", "Another video is on its way: wait until it has arrived.");
  if (file.size > now.maxBytes) return say("start-error", `This video has ${size(file.size)}; at most ${size(now.maxBytes)} are taken. Cut it first.`);
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
