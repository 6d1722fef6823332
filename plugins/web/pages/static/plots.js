// Curves over a trial's time line as SVG, one panel above the other, and the frame at the cursor.
// Times are seconds; those that must not be rounded are whole nanoseconds as text.

const LEFT = 58, RIGHT = 10, TOP = 8, BOTTOM = 20, CLOSE_S = 0.3, GRAB_PX = 9;
export const KINDS = ["incipient", "gross"];
export const seconds = (ns) => Number(ns) / 1e9;
// a line moved by hand is set to a tenth of a millisecond
const nanoseconds = (time) => String(BigInt(Math.round(time * 1e4)) * 100000n);

const left = (event, svg) => event.clientX - svg.getBoundingClientRect().left;

function add(parent, name, attributes = {}, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return parent.appendChild(made);
}

function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= raw);
  const digits = Math.max(0, -Math.floor(Math.log10(step)));
  const found = [];
  for (let at = Math.ceil(low / step) * step; at <= high + step / 1e6; at += step)
    found.push([at, Number(at.toFixed(digits)).toLocaleString("en", { minimumFractionDigits: digits })]);
  return found;
}

// One axis of time for all panels. `change` is called when a person has moved an onset line,
// `cursor` with the time at the pointer. Without `change` the lines cannot be moved.
export class Panels {
  constructor(parent, { change = null, cursor = () => {} }) {
    Object.assign(this, { parent, change, cursor, trial: null, lines: {}, held: null, at: null });
    new ResizeObserver(() => this.draw()).observe(parent);
  }

  show(trial, lines) {
    Object.assign(this, { trial, lines: { ...lines }, close: false, range: [...trial.span], at: null });
    this.parent.replaceChildren(...trial.panels.map((panel, place) => this.panel(panel, place)));
    this.draw();
  }

  panel(panel, place) {
    const figure = document.createElement("figure"), caption = figure.appendChild(document.createElement("figcaption"));
    figure.className = "plot";
    caption.append(panel.unit ? `${panel.name} (${panel.unit})` : panel.name);
    const named = new Map(panel.curves.filter((curve) => curve.name).map((curve) => [curve.name, curve.kind]));
    for (const [name, kind] of [...named].reverse()) {
      const key = caption.appendChild(document.createElement("span"));
      key.className = `key ${kind}`;
      key.textContent = name;
    }
    const svg = add(figure, "svg", { role: "group", "aria-label": `${panel.name} over time` });
    svg.style.height = place ? "150px" : "280px";
    svg.addEventListener("pointermove", (event) => this.moved(event, svg));
    svg.addEventListener("pointerdown", (event) => this.pressed(event, svg));
    svg.addEventListener("pointerup", () => { this.held = null; });
    svg.addEventListener("wheel", (event) => this.wheeled(event, svg), { passive: false });
    svg.addEventListener("dblclick", () => this.zoom(null));
    return figure;
  }

  get svgs() { return [...this.parent.querySelectorAll("figure > svg")]; }

  scale(svg) {
    const width = svg.clientWidth - LEFT - RIGHT, [start, end] = this.range;
    return {
      x: (time) => LEFT + (time - start) / (end - start) * width,
      time: (x) => start + (x - LEFT) / width * (end - start),
    };
  }

  draw() {
    if (this.trial) this.svgs.forEach((svg, place) => this.drawPanel(svg, this.trial.panels[place], place));
  }

  drawPanel(svg, panel, place) {
    const height = svg.clientHeight, width = svg.clientWidth, { x } = this.scale(svg);
    const moved = panel.name === "displacement", threshold = moved ? this.trial.threshold : null;
    let low = 0, high = threshold === null ? 0 : 2 * threshold;
    for (const { y } of panel.curves)
      for (const value of y) if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); }
    if (moved && this.close) high = Math.min(high, 5 * threshold);
    high = high > low ? high + 0.05 * (high - low) : low + 1;
    const y = (value) => height - BOTTOM - (value - low) / (high - low) * (height - TOP - BOTTOM);
    svg.replaceChildren();
    [svg.dataset.start, svg.dataset.end] = this.range;
    const id = `area-${place}`, area = { x: LEFT, y: TOP, width: Math.max(0, width - LEFT - RIGHT), height: height - TOP - BOTTOM };
    add(add(svg, "clipPath", { id }), "rect", area);
    add(svg, "rect", { ...area, class: "area" });
    for (const [at, text] of ticks(low, high, height / 60)) {
      add(svg, "path", { class: "grid", d: `M${LEFT} ${y(at)}H${width - RIGHT}` });
      add(svg, "text", { x: LEFT - 6, y: y(at) + 4, "text-anchor": "end" }, text);
    }
    for (const [at, text] of ticks(...this.range, width / 90)) {
      add(svg, "path", { class: "grid", d: `M${x(at)} ${TOP}V${height - BOTTOM}` });
      add(svg, "text", { x: x(at), y: height - 5, "text-anchor": "middle" }, `${text} s`);
    }
    const inside = add(svg, "g", { "clip-path": `url(#${id})` });
    for (const curve of panel.curves) {
      let path = "", pen = "M";
      curve.y.forEach((value, i) => {
        if (value !== null) path += `${pen}${x(panel.x[i]).toFixed(1)} ${y(value).toFixed(1)}`;
        pen = value === null ? "M" : "L";
      });
      add(inside, "path", { class: `curve ${curve.kind}`, d: path });
    }
    const upright = (time, kind) => add(inside, "path", { class: kind, d: `M${x(time)} ${TOP}V${height - BOTTOM}` });
    upright(this.trial.motion, "motion");
    for (const [name, onsets] of Object.entries(this.trial.onsets))
      for (const kind of KINDS)
        if (name !== "suggested" && onsets[`${kind}_ns`] !== null) upright(seconds(onsets[`${kind}_ns`]), `onset ${kind} ${name}`);
    if (threshold !== null) add(inside, "path", { class: "threshold", d: `M${LEFT} ${y(threshold)}H${width - RIGHT}` });
    if (moved) for (const [time, from, to] of this.trial.crossings) {
      add(inside, "path", { class: "crossing", d: `M${x(from)} ${y(threshold)}H${x(to)}` });
      add(inside, "circle", { class: "crossing", cx: x(time), cy: y(threshold), r: 3 });
    }
    if (this.change) for (const kind of KINDS) this.line(inside, kind, height, place);
    add(inside, "path", { class: "cursor", d: `M0 ${TOP}V${height - BOTTOM}` });
    this.placed(svg);
  }

  line(parent, kind, height, place) {
    const first = place === 0, group = add(parent, "g", { class: `line ${kind}`, "data-kind": kind });
    add(group, "path", { d: `M0 ${TOP}V${height - BOTTOM}` });
    if (!first) return;
    add(group, "text", { x: 6, y: TOP + (kind === "incipient" ? 14 : 32) }, `${kind} \u2194`);
    for (const [key, value] of Object.entries({ tabindex: 0, role: "slider", "aria-label": `${kind} onset` })) group.setAttribute(key, value);
    group.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!by) return;
      event.preventDefault();
      event.stopPropagation();
      this.put(kind, seconds(this.lines[`${kind}_ns`]) + by * (event.shiftKey ? 0.01 : 0.001));
    });
  }

  // put the lines and the cursor where they belong, without drawing anything else again
  placed(svg) {
    const { x } = this.scale(svg);
    for (const group of svg.querySelectorAll(".line")) {
      const ns = this.lines[`${group.dataset.kind}_ns`];
      group.style.display = ns === null ? "none" : "";
      if (ns === null) continue;
      group.setAttribute("transform", `translate(${x(seconds(ns))} 0)`);
      if (group.hasAttribute("role")) {
        const [start, end] = this.trial.span;
        for (const [key, value] of Object.entries({ now: seconds(ns), min: start, max: end, text: `${seconds(ns).toFixed(4)} s` }))
          group.setAttribute(`aria-value${key}`, value);
      }
    }
    const cursor = svg.querySelector(".cursor");
    cursor.style.display = this.at === null ? "none" : "";
    if (this.at !== null) cursor.setAttribute("transform", `translate(${x(this.at)} 0)`);
  }

  place(lines) {
    this.lines = { ...lines };
    this.svgs.forEach((svg) => this.placed(svg));
  }

  put(kind, time) {
    const [start, end] = this.trial.span;
    const ns = time === null ? null : nanoseconds(Math.min(Math.max(time, start), end));
    this.place({ ...this.lines, [`${kind}_ns`]: ns });
    this.change?.();
  }

  mark(time) {
    this.at = time;
    this.svgs.forEach((svg) => this.placed(svg));
  }

  zoom(time) {
    const [start, end] = this.trial.span;
    this.close = time !== null;
    this.range = this.close ? [Math.max(start, time - CLOSE_S), Math.min(end, time + CLOSE_S)] : [start, end];
    this.draw();
  }

  near(event, svg) {
    if (!this.change) return null;
    const { x } = this.scale(svg), reach = event.pointerType === "touch" ? 2 * GRAB_PX : GRAB_PX;
    const far = (kind) => Math.abs(x(seconds(this.lines[`${kind}_ns`])) - left(event, svg));
    return KINDS.filter((kind) => this.lines[`${kind}_ns`] !== null && far(kind) < reach).sort((a, b) => far(a) - far(b))[0] ?? null;
  }

  pressed(event, svg) {
    if (event.button !== 0) return;
    this.held = this.near(event, svg);
    if (this.held) svg.setPointerCapture(event.pointerId);
    else this.moved(event, svg);
  }

  moved(event, svg) {
    const time = this.scale(svg).time(left(event, svg));
    svg.style.cursor = this.held || this.near(event, svg) ? "ew-resize" : "";
    if (this.held) this.put(this.held, time);
    else this.cursor(Math.min(Math.max(time, this.trial.span[0]), this.trial.span[1]));
  }

  // a wheel alone scrolls the page
  wheeled(event, svg) {
    if (!event.ctrlKey && !event.shiftKey) return;
    event.preventDefault();
    const at = this.scale(svg).time(left(event, svg)), factor = event.deltaY + event.deltaX > 0 ? 1.25 : 0.8;
    const bound = (time) => Math.min(Math.max(time, this.trial.span[0]), this.trial.span[1]);
    const [start, end] = this.range.map((time) => bound(at + (time - at) * factor));
    if (end - start > 1e-3) this.range = [start, end];
    this.draw();
  }
}

// The frame nearest to a time. While one is fetched only the newest request waits.
export class Frame {
  constructor(figure, shown) {
    Object.assign(this, { figure, shown, address: "", next: null, busy: false });
  }

  get time() { const svg = this.figure.querySelector("svg"); return svg ? Number(svg.dataset.time) : null; }

  get index() { const svg = this.figure.querySelector("svg"); return svg ? Number(svg.dataset.frame) : null; }

  of(address) {
    Object.assign(this, { address, next: null });
    this.figure.replaceChildren();
  }

  async at(query) {
    this.next = `${this.address}?${new URLSearchParams(query)}`;
    if (this.busy) return;
    this.busy = true;
    try {
      while (this.next) {
        const wanted = this.next, address = this.address;
        this.next = null;
        const answer = await fetch(wanted);
        const text = await answer.text();
        if (address !== this.address) continue;
        if (answer.ok) this.figure.innerHTML = text;
        else this.figure.textContent = text;
        if (answer.ok) this.shown(this.time);
      }
    } finally { this.busy = false; }
  }

  step(by, count) {
    if (this.index !== null) this.at({ frame: Math.min(Math.max(this.index + by, 0), count - 1) });
  }
}
