// Asks again and again how far everything is: often while something is being done.

import { now } from "./state.js";

const SLOW = 4000, FAST = 1000; // milliseconds between two questions

let timer = 0;
let question = () => {};

export function setQuestion(ask) {
  question = ask;
}

export function pause() {
  clearTimeout(timer);
}

export function again() {
  pause();
  const { project } = now;
  const busy = project && (["running", "stopping", "waiting"].includes(project.state) || project.making || project.waiting.length);
  timer = setTimeout(question, busy ? FAST : SLOW);
}
