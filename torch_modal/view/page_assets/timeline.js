// The slider with its key-frames, and over it a curve of each sequence.

/** Frame numbers, with fractions between the frames, and their places on the time line from 0 to 1. */
class Clock {
  /** `times` rise; a closed sequence leads on from its last frame to its first, which is then frame N. */
  constructor(times, closed) {
    this.times = times;
    this.nFrames = times.length;
    const step = times.length > 1 ? (times[times.length - 1] - times[0]) / (times.length - 1) : 1;
    const stamps = closed ? [...times, times[times.length - 1] + step] : times;
    this.last = stamps.length - 1;
    const span = stamps[this.last] - stamps[0] || 1;
    this.places = stamps.map((time) => (time - stamps[0]) / span);
  }

  placeOf(frame) {
    const low = Math.min(Math.floor(frame), Math.max(this.last - 1, 0));
    const high = Math.min(low + 1, this.last);
    return this.places[low] + (frame - low) * (this.places[high] - this.places[low]);
  }

  frameAt(place) {
    let low = 0;
    while (low < this.last - 1 && this.places[low + 1] <= place) low++;
    const width = this.places[Math.min(low + 1, this.last)] - this.places[low];
    return width > 0 ? Math.min(low + Math.max(place - this.places[low], 0) / width, this.last) : low;
  }

  /** The caller's time of a frame. */
  timeOf(frame) {
    const first = this.times[0];
    const low = Math.min(Math.floor(frame), this.nFrames - 1);
    if (frame >= this.nFrames) return first;
    const high = Math.min(low + 1, this.nFrames - 1);
    return this.times[low] + (frame - low) * (this.times[high] - this.times[low]);
  }
}

/** The slider and what stands over it. */
class Timeline {
  constructor(root, clock, keyframes, onSeek) {
    this.clock = clock;
    this.slider = root.querySelector("#time");
    this.curves = root.querySelector("#curves");
    this.cursor = make("line", { class: "cursor", y1: 0, y2: 100 });
    this.slider.addEventListener("input", () => onSeek(this.#snapped(Number(this.slider.value))));
    const ticks = root.querySelector("#keyframes");
    for (const frame of keyframes) {
      const tick = make("button", { type: "button", title: `Key-frame ${frame}`, "aria-label": `Key-frame ${frame}` });
      tick.style.setProperty("--place", clock.placeOf(frame));
      tick.addEventListener("click", () => onSeek(frame));
      ticks.append(tick);
    }
    this.show(0);
  }

  show(frame) {
    const place = this.clock.placeOf(frame);
    this.slider.value = place;
    for (const end of ["x1", "x2"]) this.cursor.setAttribute(end, 1000 * place);
  }

  /** A frame is held a little way around its place, so that frames are easy to meet. */
  #snapped(place) {
    const frame = this.clock.frameAt(place);
    const near = Math.round(frame);
    const pixels = Math.abs(this.clock.placeOf(near) - place) * this.slider.clientWidth;
    return pixels < 3 ? near : frame;
  }

  /** Draw `values` (a list for each sequence, or null) with `colors`, on a scale from `low` to `high`. */
  draw(values, colors, low, high) {
    this.curves.replaceChildren();
    if (!values) return;
    const height = (value) => 96 - (92 * (value - low)) / (high - low || 1);
    if (low < 0) {
      this.curves.append(make("line", { class: "zero", x1: 0, x2: 1000, y1: height(0), y2: height(0) }));
    }
    values.forEach((list, number) => {
      if (!list) return;
      const points = list.map((value, frame) => `${(1000 * this.clock.places[frame]).toFixed(2)} ${height(value)}`);
      this.curves.append(make("path", { d: `M${points.join("L")}`, stroke: colors[number] }));
    });
    this.curves.append(this.cursor);
  }
}
