// Landmarks on several meshes: the first click on each is the first landmark, and so on.

const TINT = [0.62, 0.71, 0.82];

/** One mesh with a camera of its own, and the numbers of the landmarks on it. */
class Panel {
  constructor(data, faces, points) {
    this.data = data;
    this.canvas = make("canvas", { "aria-label": `${data.name}: drag to orbit, wheel to zoom, click to pick a vertex` });
    this.marks = make("div", { class: "marks", "aria-hidden": "true" });
    this.element = make("section", { class: "panel" }, this.canvas, make("div", { class: "name" }, data.name), this.marks);
    find("panels").append(this.element);
    this.changed = true;
    this.stage = new Stage(this.canvas, data.view, () => (this.changed = true));
    this.actor = this.stage.add(data.n_vertices, faces, edgesOf(faces));
    this.actor.position.array.set(points);
    this.actor.changed(faces);
    this.actor.uniforms.tint.value = TINT;
    this.actor.setLook(1, 1);
    this.picks = [];
  }

  layOut() {
    this.stage.layOut([0], false);
    this.changed = true;
  }

  /** Vertices in the order of the landmarks, null where there is none yet. */
  setPicks(picks) {
    this.picks = picks;
    this.actor.setMarks(picks.filter((vertex) => vertex !== null));
    this.changed = true;
  }

  draw() {
    this.stage.draw();
    const labels = this.picks.flatMap((vertex, i) => {
      if (vertex === null) return [];
      const label = make("span", { class: "mark" }, String(i + 1));
      const { x, y } = this.placeOf(vertex);
      Object.assign(label.style, { left: `${x}px`, top: `${y}px` });
      return [label];
    });
    this.marks.replaceChildren(...labels);
    this.changed = false;
  }

  placeOf(vertex) {
    return this.stage.placeOf(vertex, 0, this.stage.viewports[0]);
  }
}

class Landmarks {
  constructor(panels, rows) {
    this.panels = panels;
    this.rows = rows; // a vertex of each mesh; only the last may have gaps
    this.clicks = []; // what each one was before, for Undo
    panels.forEach((panel, column) => {
      whenClicked(panel.canvas, (x, y) => {
        const vertex = panel.stage.vertexAt(x, y);
        if (vertex !== null) this.pick(column, vertex);
      });
    });
    const click = (id, act) => find(id).addEventListener("click", act);
    click("reset", () => panels.forEach((panel) => panel.stage.resetView()));
    click("undo", () => this.undo());
    click("clear", () => this.change([]));
    click("copy", () => copyFrom(find("text"), find("copy")));
    click("save", () => this.save());
    find("wireframe").addEventListener("change", () => this.#showWires());
    document.addEventListener("keydown", ({ key, ctrlKey, metaKey, altKey }) => {
      if (ctrlKey || metaKey || altKey) return;
      if (key === "Backspace") this.undo();
      if (key === "r") panels.forEach((panel) => panel.stage.resetView());
    });
    new ResizeObserver(() => panels.forEach((panel) => panel.layOut())).observe(find("stage"));
    panels.forEach((panel) => (panel.layOut(), panel.stage.resetView()));
    this.#showWires();
    this.#show();
  }

  get whole() {
    return this.rows.filter((row) => !row.includes(null));
  }

  /** Another vertex of the last landmark until it is whole, then the first of the next. */
  pick(column, vertex) {
    if (this.whole.some((row) => row[column] === vertex)) return;
    const rows = this.rows.map((row) => [...row]);
    if (!rows.length || !rows.at(-1).includes(null)) rows.push(this.panels.map(() => null));
    rows.at(-1)[column] = vertex;
    this.change(rows);
  }

  change(rows) {
    this.clicks.push(this.rows);
    this.rows = rows;
    this.#show();
  }

  undo() {
    if (!this.clicks.length) return;
    this.rows = this.clicks.pop();
    this.#show();
  }

  /** A line for each landmark, as --landmarks reads it. */
  get text() {
    const names = this.panels.map(({ data }) => data.name.replace(/\s+/g, " "));
    return [`# ${names.join("  ")}`, ...this.whole.map((row) => row.join("\t")), ""].join("\n");
  }

  save() {
    const link = make("a", { download: "landmarks.txt" });
    link.href = URL.createObjectURL(new Blob([this.text], { type: "text/plain" }));
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  #showWires() {
    for (const panel of this.panels) {
      panel.actor.wires.visible = find("wireframe").checked;
      panel.changed = true;
    }
  }

  #show() {
    this.panels.forEach((panel, column) => panel.setPicks(this.rows.map((row) => row[column])));
    const open = this.rows.at(-1)?.indexOf(null) ?? -1;
    const next = this.rows.length + (open < 0);
    const where = open < 0 ? "any mesh" : this.panels[open].data.name;
    const enough = this.whole.length < 5 ? "; five make a map safe" : "";
    find("hint").textContent = `Landmark ${next}: click on ${where}${enough}`;
    find("text").value = this.text;
    find("save").disabled = find("copy").disabled = !this.whole.length;
    find("undo").disabled = !this.clicks.length;
    find("chips").replaceChildren(
      ...this.rows.map((row, i) => {
        const words = row.map((vertex) => vertex ?? "?").join(" – ");
        const chip = make("button", { type: "button", title: "Remove" }, `${i + 1}: ${words}`);
        chip.addEventListener("click", () => this.change(this.rows.filter((other) => other !== row)));
        return chip;
      }),
    );
  }

  start() {
    const turn = () => {
      for (const panel of this.panels) if (panel.changed) panel.draw();
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
  }
}

async function main() {
  const { meshes, landmarks } = JSON.parse(find("data").textContent);
  const panels = [];
  for (const data of meshes) {
    const faces = await unpackFaces(data.faces, data.n_faces);
    const [points] = await unpackFrames(data.sequences[0].frames, 1, data.n_vertices);
    panels.push(new Panel({ ...data, name: data.sequences[0].name }, faces, points));
  }
  const picker = new Landmarks(panels, landmarks);
  find("message").hidden = true;
  picker.start();
  requestAnimationFrame(() => setTimeout(() => (window.torchModal.readyAfter = performance.now())));
  // For scripts around the page.
  window.torchModal = {
    /** Whether all is drawn. */
    get idle() {
      return panels.every((panel) => !panel.changed);
    },
    /** What Copy and Save give. */
    get text() {
      return picker.text;
    },
    /** Where a vertex of a mesh is seen, in pixels of the window. */
    placeOf(vertex, mesh) {
      const { left, top } = panels[mesh].canvas.getBoundingClientRect();
      const { x, y } = panels[mesh].placeOf(vertex);
      return { x: left + x, y: top + y };
    },
  };
}

main().catch(sayWhy);
