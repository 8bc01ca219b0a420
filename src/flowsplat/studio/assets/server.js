// Asks the server, and says beside it what went wrong.

import { say } from "./page.js";
import { changed, now } from "./state.js";

export const pending = new Set(); // what was asked and not answered yet

export function ask(method, path, body) {
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

// Runs what was asked for, and says beside it what went wrong.
export async function attempt(place, what) {
  say(place, "");
  try {
    return await what();
  } catch (error) {
    say(place, error.message);
    return undefined;
  }
}

let saving = Promise.resolve();

// Saves what is chosen, one after the other; resolves when this is saved.
export function save(place) {
  const { id, choices } = now.project;
  const body = structuredClone(choices);
  saving = saving.catch(() => {}).then(() => attempt(place, async () => {
    const found = await ask("PUT", `/api/projects/${id}/choices`, body);
    if (now.project && now.project.id === id) {
      now.project.command = found.command;
      now.project.changed = found.changed;
      now.project.idle = found.idle;
      changed();
    }
    return true;
  }));
  return saving;
}

// Does something with the scene that is shown.
export async function act(place, action, body) {
  return attempt(place, async () => {
    await saving;
    const found = await ask("POST", `/api/projects/${now.project.id}/${action}`, body);
    if (action === "copy") location.hash = found.id;
    else {
      now.project = found;
      changed();
    }
  });
}
