// The state of the page, its controls, and the loop.

// Of each sequence: the colour of its in-betweens where several are overlaid, and of its curves and trails.
const LOOKS = [
  { tint: [0.62, 0.71, 0.82], line: "#4a78ab" },
  { tint: [0.88, 0.6, 0.62], line: "#b8474d" },
  { tint: [0.59, 0.78, 0.64], line: "#3b8a52" },
  { tint: [0.76, 0.68, 0.87], line: "#7a57b0" },
  { tint: [0.8, 0.77, 0.56], line: "#8b7d1f" },
];
const GIVEN = [0.91, 0.6, 0.36]; // key-frames, as in the pictures
const COMPUTED = LOOKS[0].tint;

class Viewer {
  constructor(data, faces, sequences) {
    Object.assign(this, { data, faces, sequences });
    this.names = data.sequences.map(({ name }) => name);
    this.nVertices = data.n_vertices;
    this.edges = edgesOf(faces);
    this.measures = measuresOf(faces, this.edges, this.nVertices, data.diagonal);
    this.clock = new Clock(data.times, data.closed);
    this.keyframes = data.keyframes;
    this.frame = 0;
    this.drawn = 0;
    this.busy = 0;
    this.measuring = false;
    this.playing = false;
    this.forward = true;
    this.overlaid = false;
    this.visible = this.names.map(() => true);
    this.measure = null;
    this.reference = "keys";
    this.picks = [];
    this.most = 1;
    this.keyMeasures = new Map();
    this.values = new Float32Array(this.nVertices);
    this.scratch = new Float32Array(3 * this.nVertices);
    this.shapeChanged = this.viewChanged = true;
    this.stage = new Stage(find("canvas"), data.view, () => (this.viewChanged = true));
    this.actors = sequences.map(() => this.stage.add(this.nVertices, faces, this.edges));
    const seek = (frame) => (this.pause(), this.seek(frame));
    this.timeline = new Timeline(document, this.clock, this.keyframes, seek);
    this.#connect();
    this.layOut();
    this.stage.resetView();
    this.#say();
  }

  // ------------------------------------------------------------------------------------------------- shapes
  /** The shape of a sequence at a frame, which may lie between two, into `out`. */
  shapeAt(number, frame, out) {
    const frames = this.sequences[number];
    const low = Math.floor(frame);
    return blend(frames[low % frames.length], frames[(low + 1) % frames.length], frame - low, out);
  }

  /** What the present measure makes of the reference of a sequence at a frame. */
  #rest(number, frame) {
    const measure = this.measures[this.measure];
    if (this.reference === "first") return this.#ofFrame(number, 0);
    if (this.reference !== "keys") return measure.of(this.shapeAt(Number(this.reference), frame, this.scratch));
    const { closed } = this.data;
    const keys = closed && this.keyframes[0] === 0 ? [...this.keyframes, this.clock.nFrames] : this.keyframes;
    const after = keys.findIndex((key) => key > frame);
    if (after <= 0) return this.#ofFrame(number, keys.at(after) % this.clock.nFrames); // the first or the last
    const [from, to] = [keys[after - 1], keys[after]];
    const places = [from, frame, to].map((key) => this.clock.placeOf(key));
    const part = (places[1] - places[0]) / (places[2] - places[0]);
    return measure.mix(this.#ofFrame(number, from), this.#ofFrame(number, to % this.clock.nFrames), part);
  }

  /** The present measure of a whole frame that serves as a reference, kept. */
  #ofFrame(number, frame) {
    const key = `${this.measure} ${number} ${frame}`;
    if (!this.keyMeasures.has(key)) {
      this.keyMeasures.set(key, this.measures[this.measure].of(this.sequences[number][frame]));
    }
    return this.keyMeasures.get(key);
  }

  /** Numbers of all vertices into `out`; the mean of the shape. */
  #measured(number, points, frame, out) {
    const measure = this.measures[this.measure];
    return measure.compare(measure.of(points), this.#rest(number, frame), out);
  }

  /** Bring everything that is drawn to the present frame. */
  #updateShapes() {
    const near = Math.min(...this.keyframes.map((key) => this.#framesAway(key)));
    const given = Math.max(0, 1 - near);
    this.actors.forEach((actor, number) => {
      if (!this.visible[number]) return;
      const points = this.shapeAt(number, this.frame, actor.position.array);
      actor.changed(this.faces);
      const own = this.overlaid ? LOOKS[number % LOOKS.length].tint : COMPUTED;
      actor.uniforms.tint.value = this.overlaid ? own : own.map((c, i) => c + given * (GIVEN[i] - c));
      actor.uniforms.painted.value = this.measure ? 1 : 0;
      if (this.measure) {
        this.means[number] = this.#measured(number, points, this.frame, this.values);
        paint(this.values, this.most, this.measures[this.measure].signed, actor.paint.array);
        actor.paint.needsUpdate = true;
      }
      actor.setMarks(this.picks);
    });
    this.timeline.show(this.frame);
    this.#say();
  }

  #framesAway(key) {
    const direct = Math.abs(this.frame - key);
    return this.data.closed ? Math.min(direct, this.clock.nFrames - direct) : direct;
  }

  // -------------------------------------------------------------------------------------------------- state
  seek(frame) {
    this.frame = Math.min(Math.max(frame, 0), this.clock.last);
    this.shapeChanged = true;
  }

  play() {
    if (this.clock.last === 0) return;
    const ending = find("ending").value;
    if (ending !== "turn") this.forward = true;
    if (ending === "stop" && this.frame >= this.clock.last) this.seek(0);
    this.playing = true;
    this.#showPlaying();
  }

  pause() {
    this.playing = false;
    this.#showPlaying();
  }

  #showPlaying() {
    find("play").setAttribute("aria-pressed", this.playing);
    find("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  #advance(seconds) {
    const length = this.clock.last / this.data.fps; // seconds of the whole at speed 1
    let place = this.clock.placeOf(this.frame);
    place += ((this.forward ? 1 : -1) * seconds * Number(find("speed").value)) / length;
    const ending = find("ending").value;
    if (ending === "loop") place -= Math.floor(place);
    else if (place > 1 || place < 0) {
      if (ending === "stop") this.pause();
      else this.forward = place < 0;
      place = Math.min(Math.max(place, 0), 1);
    }
    this.seek(this.clock.frameAt(place));
  }

  layOut() {
    const shown = [...this.names.keys()].filter((number) => this.visible[number]);
    this.stage.layOut(shown, this.overlaid);
    this.actors.forEach((actor, number) => {
      const order = shown.indexOf(number);
      actor.setLook(this.overlaid && order > 0 ? 0.45 : 1, order + 1);
    });
    find("labels").replaceChildren();
    for (const port of this.stage.viewports) {
      port.shown.forEach((number, line) => {
        const label = make("div", { class: "name", id: `name-${number}` }, this.names[number], make("small"));
        label.style.setProperty("--color", LOOKS[number % LOOKS.length].line);
        Object.assign(label.style, { left: `${port.x}px`, top: `${port.y + 22 * line}px` });
        find("labels").append(label);
      });
    }
    this.shapeChanged = true;
  }

  setTrails() {
    const wanted = find("trails").checked ? this.picks : [];
    this.actors.forEach((actor, number) => {
      const color = LOOKS[number % LOOKS.length].line;
      actor.setTrails(this.sequences[number], wanted, this.keyframes, this.data.closed, color);
    });
    this.viewChanged = true;
  }

  setPicks(picks) {
    this.picks = picks;
    find("hint").hidden = picks.length > 0;
    find("picks").hidden = picks.length === 0;
    find("indices").value = picks.join(", ");
    find("chips").replaceChildren(
      ...picks.map((vertex) => {
        const chip = make("button", { type: "button", title: "Remove" }, String(vertex));
        chip.addEventListener("click", () => this.setPicks(picks.filter((other) => other !== vertex)));
        return chip;
      }),
    );
    this.setTrails();
    this.shapeChanged = true;
  }

  // ------------------------------------------------------------------------------------------------ measures
  /** The scale and the curves of the present measure, in parts so that the page stays responsive. */
  async measureAll() {
    const run = (this.run = {}); // a later call makes this one stop
    find("legend").hidden = find("against").hidden = !this.measure;
    document.body.classList.toggle("measured", Boolean(this.measure));
    this.means = this.names.map(() => null);
    this.layOut();
    this.timeline.draw(null);
    find("highest").textContent = "";
    this.measuring = Boolean(this.measure);
    if (!this.measure) return;
    const { signed, label } = this.measures[this.measure];
    const stops = (signed ? TWO_SIDED : SEQUENTIAL).map((rgb) => `rgb(${rgb.map((c) => 255 * c)})`);
    find("scale").style.background = `linear-gradient(to right, ${stops})`;
    const values = new Float32Array(this.nVertices);
    const curves = this.names.map((_, number) => (this.visible[number] ? [] : null));
    const every = Math.ceil(this.clock.nFrames / 24); // frames whose vertices count for the scale
    let top = 0;
    let since = performance.now();
    for (let frame = 0; frame < this.clock.nFrames; frame++) {
      for (const [number, curve] of curves.entries()) {
        if (!curve) continue;
        curve.push(this.#measured(number, this.sequences[number][frame], frame, values));
        if (frame % every === 0) top = Math.max(top, percentile(values.map(Math.abs), 0.99));
      }
      if (performance.now() - since < 12) continue;
      await new Promise((resume) => setTimeout(resume));
      if (this.run !== run) return;
      since = performance.now();
    }
    this.measuring = false;
    this.setScale(rounded(top));
    const all = curves.filter(Boolean).flat();
    const low = signed ? Math.min(0, ...all) : 0;
    const high = Math.max(0, ...all);
    const range = signed ? `${low.toFixed(2)} to ${high.toFixed(2)} %` : `up to ${high.toFixed(2)} % in the mean`;
    find("highest").textContent = `${label}: ${range}`;
    this.timeline.draw(curves, this.names.map((_, number) => LOOKS[number % LOOKS.length].line), low, high);
  }

  setScale(most) {
    this.most = most;
    find("most").value = most;
    find("least").textContent = this.measures[this.measure].signed ? `-${most} %` : "0";
    this.shapeChanged = true;
  }

  // ------------------------------------------------------------------------------------------------ controls
  #say() {
    const whole = Number.isInteger(Number(this.frame.toFixed(2)));
    const time = this.clock.timeOf(this.frame);
    const shown = `${this.frame.toFixed(whole ? 0 : 1)} / ${this.clock.nFrames - 1}`;
    find("readout").textContent = `frame ${shown}` + (this.data.has_times ? `, t = ${Number(time.toFixed(3))}` : "");
    for (const [number] of this.names.entries()) {
      const note = document.querySelector(`#name-${number} small`);
      const mean = this.measure ? this.means[number] : null;
      if (note) note.textContent = mean === null ? "" : `${mean.toFixed(2)} %`;
    }
  }

  #placeMarks() {
    const marks = this.stage.viewports.flatMap((port) =>
      this.picks.flatMap((vertex) => (port.shown.length ? [[vertex, port]] : [])),
    );
    const labels = find("marks");
    while (labels.children.length > marks.length) labels.lastChild.remove();
    while (labels.children.length < marks.length) labels.append(make("span", { class: "mark" }));
    marks.forEach(([vertex, port], i) => {
      const { x, y } = this.stage.placeOf(vertex, port.shown[0], port);
      labels.children[i].textContent = vertex;
      Object.assign(labels.children[i].style, { left: `${x}px`, top: `${y}px` });
    });
  }

  #connect() {
    this.names.forEach((name, number) => {
      const chip = make("button", { type: "button", "aria-pressed": "true", title: "Show or hide" }, name);
      chip.style.setProperty("--color", LOOKS[number % LOOKS.length].line);
      chip.addEventListener("click", () => {
        this.visible[number] = !this.visible[number];
        chip.setAttribute("aria-pressed", this.visible[number]);
        this.measureAll();
      });
      find("sequences").append(chip);
      if (this.names.length > 1) find("reference").append(make("option", { value: number }, name));
    });
    find("sequences").hidden = find("layout").hidden = this.names.length < 2;
    for (const button of find("layout").children) {
      button.addEventListener("click", () => {
        this.overlaid = button.value === "over";
        for (const other of find("layout").children) other.setAttribute("aria-pressed", other === button);
        this.layOut();
      });
    }
    const change = (id, act) => find(id).addEventListener("change", (event) => act(event.target));
    change("measure", ({ value }) => ((this.measure = value || null), this.measureAll()));
    change("reference", ({ value }) => ((this.reference = value), this.measureAll()));
    change("most", ({ value }) => this.setScale(Math.max(Number(value), 1e-6) || 1));
    change("wireframe", () => this.#showWires());
    change("trails", () => this.setTrails());
    change("ending", () => (this.forward = true));
    const click = (id, act) => find(id).addEventListener("click", act);
    click("reset", () => this.stage.resetView());
    click("play", () => (this.playing ? this.pause() : this.play()));
    click("clear", () => this.setPicks([]));
    click("copy", () => copyFrom(find("indices"), find("copy")));
    find("ending").value = this.data.closed ? "loop" : "turn";
    find("against").hidden = true;
    this.#showWires();
    this.#connectPicking(find("canvas"));
    document.addEventListener("keydown", (event) => this.#key(event));
    new ResizeObserver(() => this.layOut()).observe(find("stage"));
  }

  #showWires() {
    for (const actor of this.actors) actor.wires.visible = find("wireframe").checked;
    this.viewChanged = true;
  }

  #connectPicking(canvas) {
    whenClicked(canvas, (x, y) => {
      const vertex = this.stage.vertexAt(x, y);
      if (vertex === null) return;
      const there = this.picks.includes(vertex);
      this.setPicks(there ? this.picks.filter((other) => other !== vertex) : [...this.picks, vertex]);
    });
  }

  #key(event) {
    const { target, key } = event;
    const typing = target.matches("select, input[type=number], input[readonly]");
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const stops = event.shiftKey ? this.keyframes : [...Array(this.clock.nFrames).keys()];
    const acts = {
      " ": () => (this.playing ? this.pause() : this.play()),
      ArrowRight: () => this.seek(stops.find((stop) => stop > this.frame + 1e-6) ?? this.frame),
      ArrowLeft: () => this.seek(stops.findLast((stop) => stop < this.frame - 1e-6) ?? this.frame),
      Home: () => this.seek(0),
      End: () => this.seek(this.clock.nFrames - 1),
      r: () => this.stage.resetView(),
    };
    if (!(key in acts) || (key === " " && target.matches("button, input[type=checkbox]"))) return;
    event.preventDefault();
    if (key !== " " && key !== "r") this.pause();
    acts[key]();
  }

  // ---------------------------------------------------------------------------------------------------- loop
  start() {
    let last = performance.now();
    const turn = (now) => {
      const began = performance.now();
      if (this.playing) this.#advance(Math.min((now - last) / 1000, 0.25));
      last = now;
      if (this.shapeChanged) this.#updateShapes();
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
}

/** A little more than a number, and short to write. */
function rounded(number) {
  const unit = 10 ** Math.floor(Math.log10(Math.max(number, 0.01)));
  return Number(([1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((digit) => digit * unit >= number) * unit).toPrecision(2));
}

async function main() {
  const data = JSON.parse(find("data").textContent);
  const faces = await unpackFaces(data.faces, data.n_faces);
  const unpack = ({ frames }) => unpackFrames(frames, data.times.length, data.n_vertices);
  const viewer = new Viewer(data, faces, await Promise.all(data.sequences.map(unpack)));
  find("message").hidden = true;
  viewer.start();
  requestAnimationFrame(() => setTimeout(() => (window.torchModal.readyAfter = performance.now())));
  // For scripts around the page; frames may have fractions.
  window.torchModal = {
    seek: (frame) => viewer.seek(frame),
    get frame() {
      return viewer.frame;
    },
    /** Whether all is drawn, and nothing moves. */
    get idle() {
      return !(viewer.playing || viewer.measuring || viewer.shapeChanged || viewer.viewChanged);
    },
    /** How many pictures have been drawn so far. */
    get drawn() {
      return viewer.drawn;
    },
    /** Milliseconds that the page's scripts took for them. */
    get busy() {
      return viewer.busy;
    },
    /** Where a vertex is at the present frame, in the coordinates of the caller. */
    positionOf(vertex, sequence = 0) {
      const steps = viewer.actors[sequence].position.array.slice(3 * vertex, 3 * vertex + 3);
      return data.origin.map((start, axis) => start + data.step * steps[axis]);
    },
    /** Where a vertex is seen, in pixels of the window. */
    placeOf(vertex, sequence = 0) {
      const port = viewer.stage.viewports.find((candidate) => candidate.shown.includes(sequence));
      const { left, top } = find("canvas").getBoundingClientRect();
      const { x, y } = viewer.stage.placeOf(vertex, sequence, port);
      return { x: left + x, y: top + y };
    },
  };
}

main().catch(sayWhy);
