// The page: its state, controls and loop. One group of sequences plays; of several groups, landmarks are picked.

// The colour of each sequence: of its in-betweens where several are overlaid, and of its trails.
const LOOKS = [
  { tint: [0.62, 0.71, 0.82], line: "#4a78ab" },
  { tint: [0.88, 0.6, 0.62], line: "#b8474d" },
  { tint: [0.59, 0.78, 0.64], line: "#3b8a52" },
  { tint: [0.76, 0.68, 0.87], line: "#7a57b0" },
  { tint: [0.8, 0.77, 0.56], line: "#8b7d1f" },
];
const GIVEN = [0.91, 0.6, 0.36]; // key-frames, as in the pictures
const PRESS = matchMedia("(pointer: coarse)").matches ? "Tap" : "Click"; // as a finger or a mouse does
const CLICK_PIXELS = 4; // a press that moves further turns the camera
const SNAP_PIXELS = 3; // the slider meets frames that are as near
const ENOUGH_LANDMARKS = 5;

const find = (id) => document.getElementById(id);

/** An element with attributes and children; text children are text, never markup. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Frames, with fractions between them, their times, and their places from 0 to 1 on the time line. */
class Clock {
  /** `times` rise; of a closed sequence, the last one is when the first frame comes again. */
  constructor(times) {
    this.times = times;
    this.last = times.length - 1;
    this.span = times[this.last] - times[0] || 1;
  }

  timeOf(frame) {
    const low = Math.min(Math.floor(frame), Math.max(this.last - 1, 0));
    const high = Math.min(low + 1, this.last);
    return this.times[low] + (frame - low) * (this.times[high] - this.times[low]);
  }

  placeOf(frame) {
    return (this.timeOf(frame) - this.times[0]) / this.span;
  }

  frameAt(place) {
    if (this.last === 0) return 0;
    const time = this.times[0] + Math.min(Math.max(place, 0), 1) * this.span;
    const low = this.times.slice(1, -1).filter((other) => other <= time).length;
    return low + (time - this.times[low]) / (this.times[low + 1] - this.times[low]);
  }
}

class Viewer {
  constructor(data, actors) {
    Object.assign(this, { data, actors });
    this.clock = new Clock(data.times);
    this.closed = data.times.length > data.n_frames;
    this.picksLandmarks = data.landmarks !== null;
    this.hasMaterials = actors.some(({ materials }) => materials.length);
    this.rows = data.landmarks ?? []; // picked vertices, one of each actor; null where it is still missing
    this.undone = []; // the rows before each change
    this.hidden = new Set();
    this.overlaid = this.playing = false;
    this.forward = true;
    this.frame = 0;
    this.drawn = this.busy = 0; // pictures so far, and milliseconds that they took
    this.shapeChanged = this.viewChanged = true;
    this.stage = new Stage(find("canvas"), find("cells"), actors, () => (this.viewChanged = true));
    this.#connect();
    this.#showWires();
    this.#showPicks();
    this.layOut();
    this.resetView();
  }

  // ------------------------------------------------------------------------------------------------- picking
  /** A vertex picked in an actor: of sequences, in all of them, or taken back; of landmarks, of the incomplete one. */
  pick(actor, vertex) {
    const column = this.actors.indexOf(actor);
    if (!this.picksLandmarks) {
      const others = this.rows.filter((row) => row[column] !== vertex);
      const added = others.length < this.rows.length ? [] : [this.actors.map(() => vertex)];
      this.setRows([...others, ...added]);
    } else if (!this.complete.some((row) => row[column] === vertex)) {
      const incomplete = this.rows.find((row) => row.includes(null)) ?? this.actors.map(() => null);
      this.setRows([...this.complete, incomplete.with(column, vertex)]);
    }
  }

  get complete() {
    return this.rows.filter((row) => !row.includes(null));
  }

  setRows(rows) {
    this.undone.push(this.rows);
    this.rows = rows;
    this.#showPicks();
  }

  undo() {
    this.rows = this.undone.pop() ?? this.rows;
    this.#showPicks();
  }

  /** Indices of the picked vertices, or the landmarks as --landmarks reads them. */
  get text() {
    if (!this.picksLandmarks) return this.rows.map(([vertex]) => vertex).join(", ");
    const names = this.actors.map(({ name }) => name.replace(/\s+/g, " "));
    return [`# ${names.join("  ")}`, ...this.complete.map((row) => row.join("\t")), ""].join("\n");
  }

  #hint() {
    if (!this.picksLandmarks) return this.rows.length ? "" : `${PRESS} on a shape to pick a vertex`;
    const incomplete = this.rows.find((row) => row.includes(null));
    const where = incomplete ? this.actors[incomplete.indexOf(null)].name : "any mesh";
    const enough = this.complete.length < ENOUGH_LANDMARKS ? `; ${ENOUGH_LANDMARKS} make a map safe` : "";
    return `Landmark ${this.complete.length + 1}: ${PRESS.toLowerCase()} on ${where}${enough}`;
  }

  /** The name of a row on its chip, and beside its vertices. */
  #chip(row, i) {
    return this.picksLandmarks ? `${i + 1}: ${row.map((vertex) => vertex ?? "?").join(" – ")}` : row[0];
  }

  #mark(row, i) {
    return this.picksLandmarks ? i + 1 : row[0];
  }

  #showPicks() {
    find("hint").textContent = this.#hint();
    find("text").value = this.text;
    find("picks").hidden = !this.rows.length && !this.picksLandmarks;
    find("copy").disabled = find("save").disabled = !this.complete.length;
    find("undo").disabled = !this.undone.length;
    find("chips").replaceChildren(
      ...this.rows.map((row, i) => {
        const chip = make("button", { type: "button", title: "Remove" }, this.#chip(row, i));
        chip.addEventListener("click", () => this.setRows(this.rows.filter((other) => other !== row)));
        return chip;
      }),
    );
    this.#showTrails();
    this.shapeChanged = true;
  }

  #showTrails() {
    const wanted = find("trails").checked && !this.picksLandmarks ? this.rows : [];
    this.actors.forEach((actor, column) => {
      const vertices = wanted.map((row) => row[column]);
      actor.setTrails(vertices, this.data.keyframes, this.closed, this.#look(column).line);
    });
    this.viewChanged = true;
  }

  async copy() {
    try {
      await navigator.clipboard.writeText(this.text);
    } catch {
      find("text").select(); // in frames, and where the page is not trusted with the clipboard
      document.execCommand("copy");
    }
    find("copy").textContent = "Copied";
    setTimeout(() => (find("copy").textContent = "Copy"), 1200);
  }

  save() {
    const link = make("a", { download: "landmarks.txt" });
    link.href = URL.createObjectURL(new Blob([this.text], { type: "text/plain" }));
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  // ------------------------------------------------------------------------------------------------- playing
  seek(frame) {
    this.frame = Math.min(Math.max(frame, 0), this.clock.last);
    this.shapeChanged = true;
  }

  play(playing) {
    this.playing = playing && this.clock.last > 0;
    const ending = find("ending").value;
    if (this.playing && ending !== "turn") this.forward = true;
    if (this.playing && ending === "stop" && this.frame >= this.clock.last) this.seek(0);
    find("play").setAttribute("aria-pressed", this.playing);
    find("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  #advance(seconds) {
    const length = this.clock.last / this.data.fps; // seconds of the whole at speed 1
    const step = (seconds * Number(find("speed").value)) / length;
    let place = this.clock.placeOf(this.frame) + (this.forward ? step : -step);
    const ending = find("ending").value;
    if (ending === "loop") place -= Math.floor(place);
    else if (place > 1 || place < 0) {
      if (ending === "stop") this.play(false);
      else this.forward = place < 0;
    }
    this.seek(this.clock.frameAt(place));
  }

  // ------------------------------------------------------------------------------------------------- drawing
  #look(column) {
    return LOOKS[column % LOOKS.length];
  }

  layOut() {
    const shown = this.actors.filter((actor) => !this.hidden.has(actor));
    this.stage.layOut(shown, this.overlaid);
    shown.forEach((actor, order) => {
      const over = this.overlaid && order > 0; // in the sequence's colour, to tell it from the first
      actor.setLook(find("materials").checked && this.hasMaterials && !over, over ? 0.45 : 1, order);
    });
    for (const cell of this.stage.cells) {
      const names = cell.actors.map((actor) => {
        const name = make("div", { class: "name" }, actor.name);
        name.style.setProperty("--color", this.#look(this.actors.indexOf(actor)).line);
        return name;
      });
      cell.names.replaceChildren(...names);
    }
    this.shapeChanged = true;
  }

  resetView() {
    for (const orbit of this.stage.orbits) orbit.reset();
    this.viewChanged = true;
  }

  #showWires() {
    for (const actor of this.actors) actor.wires.visible = find("wireframe").checked;
    this.viewChanged = true;
  }

  /** Bring all that is drawn to the present frame. */
  #update() {
    const away = this.data.keyframes.map((key) => Math.abs(this.frame - key));
    if (this.closed) away.push(...away.map((frames) => this.data.n_frames - frames));
    const given = Math.max(0, 1 - Math.min(...away));
    this.actors.forEach((actor, column) => {
      if (this.hidden.has(actor)) return;
      actor.setFrame(this.frame);
      actor.setMarks(this.rows.map((row) => row[column]).filter((vertex) => vertex !== null));
      const own = LOOKS[0].tint.map((c, i) => c + given * (GIVEN[i] - c));
      actor.uniforms.tint.value = this.overlaid ? this.#look(column).tint : own;
    });
    find("time").value = this.clock.placeOf(this.frame);
    const whole = Number.isInteger(Number(this.frame.toFixed(2)));
    const time = this.data.has_times ? `, t = ${Number(this.clock.timeOf(this.frame).toFixed(3))}` : "";
    find("readout").textContent = `frame ${this.frame.toFixed(whole ? 0 : 1)} / ${this.data.n_frames - 1}${time}`;
  }

  /** Labels beside the picked vertices, in every cell. */
  #placeMarks() {
    for (const cell of this.stage.cells) {
      const [actor] = cell.actors;
      const column = this.actors.indexOf(actor);
      const picked = actor ? this.rows.map((row, i) => [row[column], this.#mark(row, i)]) : [];
      const labels = picked.filter(([vertex]) => vertex !== null).map(([vertex, text]) => {
        const label = make("span", { class: "mark" }, text);
        const { x, y } = cell.placeOf(actor, vertex);
        Object.assign(label.style, { left: `${x}px`, top: `${y}px` });
        return label;
      });
      cell.marks.replaceChildren(...labels);
    }
  }

  start() {
    let last = performance.now();
    const turn = (now) => {
      const began = performance.now();
      if (this.playing) this.#advance(Math.min((now - last) / 1000, 0.25));
      last = now;
      if (this.shapeChanged) this.#update();
      if (this.shapeChanged || this.viewChanged) {
        this.stage.draw();
        this.#placeMarks();
        this.drawn += 1;
        this.busy += performance.now() - began;
      }
      this.shapeChanged = this.viewChanged = false;
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
  }

  /** Nothing moves, and all is drawn. */
  get idle() {
    return !(this.playing || this.shapeChanged || this.viewChanged);
  }

  /** The present position of a vertex, in the coordinates of the caller. */
  positionOf(vertex, sequence = 0) {
    const { position, group } = this.actors[sequence];
    const steps = position.array.slice(3 * vertex, 3 * vertex + 3);
    return group.origin.map((start, axis) => start + group.step * steps[axis]);
  }

  /** Where a vertex is seen, in pixels of the window. */
  placeOf(vertex, sequence = 0) {
    const actor = this.actors[sequence];
    const cell = this.stage.cells.find(({ actors }) => actors.includes(actor));
    const { left, top } = cell.element.getBoundingClientRect();
    const { x, y } = cell.placeOf(actor, vertex);
    return { x: left + x, y: top + y };
  }

  // ------------------------------------------------------------------------------------------------ controls
  #connect() {
    const on = (id, event, act) => find(id).addEventListener(event, act);
    on("play", "click", () => this.play(!this.playing));
    on("ending", "change", () => (this.forward = true));
    on("time", "input", () => this.#scrub(Number(find("time").value)));
    on("reset", "click", () => this.resetView());
    on("wireframe", "change", () => this.#showWires());
    on("materials", "change", () => this.layOut());
    on("trails", "change", () => this.#showTrails());
    on("undo", "click", () => this.undo());
    on("clear", "click", () => this.setRows([]));
    on("copy", "click", () => this.copy());
    on("save", "click", () => this.save());
    for (const button of find("layout").children) button.addEventListener("click", () => this.#overlay(button));
    for (const cell of this.stage.cells) this.#connectPicking(cell);
    this.actors.forEach((actor, column) => {
      const chip = make("button", { type: "button", "aria-pressed": "true", title: "Show or hide" }, actor.name);
      chip.style.setProperty("--color", this.#look(column).line);
      chip.addEventListener("click", () => {
        if (!this.hidden.delete(actor)) this.hidden.add(actor);
        chip.setAttribute("aria-pressed", !this.hidden.has(actor));
        this.layOut();
      });
      find("sequences").append(chip);
    });
    for (const frame of this.data.keyframes) {
      const tick = make("button", { type: "button", title: `Key-frame ${frame}`, "aria-label": `Key-frame ${frame}` });
      tick.style.setProperty("--place", this.clock.placeOf(frame));
      tick.addEventListener("click", () => (this.play(false), this.seek(frame)));
      find("keyframes").append(tick);
    }
    find("sequences").hidden = find("layout").hidden = this.actors.length < 2 || this.picksLandmarks;
    find("materials").parentElement.hidden = !this.hasMaterials;
    find("player").hidden = this.clock.last === 0;
    find("trails").parentElement.hidden = this.picksLandmarks;
    find("save").hidden = !this.picksLandmarks;
    find("ending").value = this.closed ? "loop" : "turn";
    document.addEventListener("keydown", (event) => this.#key(event));
    new ResizeObserver(() => this.layOut()).observe(find("stage"));
  }

  #overlay(button) {
    this.overlaid = button.value === "over";
    for (const other of find("layout").children) other.setAttribute("aria-pressed", other === button);
    this.layOut();
  }

  #scrub(place) {
    const frame = this.clock.frameAt(place);
    const pixels = Math.abs(this.clock.placeOf(Math.round(frame)) - place) * find("time").clientWidth;
    this.play(false);
    this.seek(pixels < SNAP_PIXELS ? Math.round(frame) : frame);
  }

  #connectPicking(cell) {
    let pressed = null;
    cell.element.addEventListener("pointerdown", (event) => (pressed = event.isPrimary && !event.button ? event : null));
    cell.element.addEventListener("pointerup", ({ clientX, clientY }) => {
      if (!pressed || Math.hypot(clientX - pressed.clientX, clientY - pressed.clientY) > CLICK_PIXELS) return;
      const { left, top } = cell.element.getBoundingClientRect();
      const hit = cell.vertexAt(clientX - left, clientY - top);
      if (hit) this.pick(hit.actor, hit.vertex);
    });
  }

  #key(event) {
    const { target, key } = event;
    if (target.matches("select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (key === " " && target.matches("button, input[type=checkbox]")) return;
    const stops = event.shiftKey ? this.data.keyframes : [...Array(this.data.n_frames).keys()];
    const show = (frame) => (this.play(false), this.seek(frame));
    const acts = {
      " ": () => this.play(!this.playing),
      ArrowRight: () => show(stops.find((stop) => stop > this.frame + 1e-6) ?? this.frame),
      ArrowLeft: () => show(stops.findLast((stop) => stop < this.frame - 1e-6) ?? this.frame),
      Home: () => show(0),
      End: () => show(this.data.n_frames - 1),
      Backspace: () => this.undo(),
      m: () => this.hasMaterials && find("materials").click(),
      r: () => this.resetView(),
    };
    if (!(key in acts)) return;
    event.preventDefault();
    acts[key]();
  }
}

/** The actors of a group, out of the page's data. */
async function actorsOf(group, nFrames) {
  group.faces = await unpackIndices(group.faces, 3 * group.n_faces);
  group.edges = edgesOf(group.faces);
  group.surface = await unpackSurface(group);
  group.textures = (group.surface.textures ?? []).map((picture) => picture && textureOf(picture));
  group.orbit = new Orbit(group.view);
  const sequences = group.sequences.map(async ({ name, frames }) => {
    return new Actor(group, name, await unpackFrames(frames, nFrames, group.n_vertices));
  });
  return Promise.all(sequences);
}

async function main() {
  const data = JSON.parse(find("data").textContent);
  const actors = (await Promise.all(data.groups.map((group) => actorsOf(group, data.n_frames)))).flat();
  const viewer = new Viewer(data, actors);
  find("message").hidden = true;
  viewer.start();
  window.torchModal = viewer; // for scripts around the page
  requestAnimationFrame(() => setTimeout(() => (viewer.readyAfter = performance.now())));
}

main().catch((error) => {
  find("message").hidden = false;
  find("message").textContent = /webgl/i.test(error.message)
    ? "This page needs WebGL 2, which this browser does not offer or has switched off."
    : `This page cannot be shown: ${error.message}`;
  console.error(error);
});
