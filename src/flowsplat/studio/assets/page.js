// Small things that every part of the page uses.

export const $ = (id) => document.getElementById(id);

export function say(id, text) {
  const place = $(id);
  place.textContent = text || "";
  place.hidden = !text;
}

export function make(kind, about = {}, ...inside) {
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

export function seconds(value) {
  return `${value.toFixed(2)} s`;
}

export function about(value) {
  if (value < 90) return `about ${Math.max(5, Math.round(value / 5) * 5)} seconds`;
  if (value < 5400) return `about ${Math.round(value / 60)} minutes`;
  return `about ${(value / 3600).toFixed(1)} hours`;
}

export function size(bytes) {
  return bytes < 1e9 ? `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB` : `${(bytes / 1e9).toFixed(1)} GB`;
}

// Sets an address only where it is another one: an image or a page would load anew.
export function show(element, address) {
  if (address && element.getAttribute("src") !== address) element.setAttribute("src", address);
  if (!address) element.removeAttribute("src");
}

// Puts in what is new: what is the same stays, so that a video plays on.
export function replace(place, inside) {
  const text = inside.map((each) => each.outerHTML).join("\n");
  if (place.dataset.shown === text && place.childElementCount === inside.length) return;
  place.dataset.shown = text;
  place.replaceChildren(...inside);
}
