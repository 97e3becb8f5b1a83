// What the scripts of all pages do with their elements.

const SVG = "http://www.w3.org/2000/svg";

/** An element with attributes and children; text children are text, never markup. */
function make(tag, attributes = {}, ...children) {
  const svg = ["svg", "path", "line", "text"].includes(tag);
  const element = svg ? document.createElementNS(SVG, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

const find = (id) => document.getElementById(id);

const CLICK_PIXELS = 4; // a press that moves further turns the camera

/** Call `act` with the place of each click on a canvas, in its own pixels; drags are none. */
function whenClicked(canvas, act) {
  let pressed = null;
  canvas.addEventListener("pointerdown", (event) => (pressed = event.isPrimary && !event.button ? event : null));
  canvas.addEventListener("pointerup", (event) => {
    const moved = pressed && Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY);
    if (moved === null || moved > CLICK_PIXELS) return;
    const { left, top } = canvas.getBoundingClientRect();
    act(event.clientX - left, event.clientY - top);
  });
}

/** Put the text of a field on the clipboard, and say so on the button for a moment. */
async function copyFrom(field, button) {
  const label = button.textContent;
  try {
    await navigator.clipboard.writeText(field.value);
  } catch {
    field.select(); // in frames, and where the page is not trusted with the clipboard
    document.execCommand("copy");
  }
  button.textContent = "Copied";
  setTimeout(() => (button.textContent = label), 1200);
}

/** Show what keeps a page from being shown. */
function sayWhy(error) {
  find("message").hidden = false;
  find("message").textContent = /webgl/i.test(error.message)
    ? "This page needs WebGL 2, which this browser does not offer or has switched off."
    : `This page cannot be shown: ${error.message}`;
  console.error(error);
}
