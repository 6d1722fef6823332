// The page of one trial: curves, the frame at the cursor, onsets, and a check of its files.
import { Frame, KINDS, Panels, seconds } from "./plots.js";

const root = document.querySelector(".trial"), address = root.dataset.address;
const figure = document.querySelector(".frame"), slider = document.querySelector(".slider");
const names = { label: "label", suggested: "by the visible markers", review: "review" };

const panels = new Panels(root.querySelector(".plots"), { cursor: (time) => frame?.at({ time }) });
const frame = figure && new Frame(figure, (time) => {
  panels.mark(time);
  slider.value = frame.index;
});

function onsets(trial) {
  const table = document.querySelector(".onsets"), body = table.tBodies[0];
  for (const [source, both] of Object.entries(trial.onsets)) {
    if (KINDS.every((kind) => both[`${kind}_ns`] === null)) continue;
    const row = body.insertRow();
    row.insertCell().textContent = names[source] ?? source;
    for (const kind of KINDS) {
      const ns = both[`${kind}_ns`];
      row.insertCell().textContent = ns === null ? "–" : `${seconds(ns).toFixed(4)} s`;
    }
  }
  table.hidden = !body.rows.length;
}

async function load() {
  const answer = await fetch(`${address}/curves`), plots = root.querySelector(".plots");
  if (!answer.ok) { plots.textContent = await answer.text(); return; }
  const trial = await answer.json();
  panels.show(trial, {});
  if (!trial.panels.length) plots.textContent = "no curves were recorded";
  onsets(trial);
  if (!frame || !trial.frames) return;
  frame.of(`${address}/frame`);
  slider.max = trial.frames - 1;
  slider.addEventListener("input", () => frame.at({ frame: slider.value }));
  const first = trial.onsets.label.incipient_ns;
  frame.at({ time: first === null ? trial.motion : seconds(first) });
}

const button = document.querySelector("button.check"), checked = document.querySelector(".checked");
button.addEventListener("click", async () => {
  button.disabled = true;
  checked.textContent = "reading …";
  try {
    const answer = await fetch(`${address}/files`);
    if (!answer.ok) { checked.textContent = await answer.text(); return; }
    const found = await answer.json();
    for (const [name, state] of found) document.querySelector(`[data-file="${CSS.escape(name)}"]`).textContent = state;
    checked.textContent = found.every(([, state]) => state === "intact") ? "all intact" : "not all intact";
  } catch (error) { checked.textContent = error.message; } finally { button.disabled = false; }
});

load();
