// The review page: a list of trials of any length, the label of one of them, and decisions.
import { Frame, KINDS, Panels, seconds } from "./plots.js";

const LOOK_MS = 2000, ROW_PX = 34;
const KEYS = {
  n: "next", ArrowDown: "next", p: "previous", ArrowUp: "previous", ArrowLeft: "back", ArrowRight: "forth",
  i: "incipient", g: "gross", a: "accept", s: "adjust", r: "reason", u: "reopen", 0: "reset", z: "zoom",
};
const root = document.querySelector(".review"), find = (what) => root.querySelector(what);
const filters = find(".filters"), listed = find(".rows"), space = find(".space"), form = find(".decide");
const decides = "decides" in root.dataset;
const same = (one, other) => Boolean(one && other) && one[0] === other[0] && one[1] === other[1];
const path = ([campaign, trial]) => `${encodeURIComponent(campaign)}/${encodeURIComponent(trial)}`;

let rows = [], changes = "", shown = null, wanted = null, deciding = false;
const panels = new Panels(find(".plots"), { change: decides ? lines : null, cursor: (time) => frame.at({ time }) });
const frame = new Frame(find(".frame"), (time) => panels.mark(time));

function say(text, good = false) {
  const line = find(".stated");
  line.textContent = text;
  line.className = `stated ${good ? "good" : "bad"}`;
}

async function get(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.status === 204 ? null : answer.json();
}

// the list

async function list(since = "") {
  const query = new URLSearchParams([...new FormData(filters)].filter(([, value]) => value));
  const asked = query.toString();
  if (since) query.set("since", since);
  const found = await get(`/review/rows?${query}`);
  const now = new URLSearchParams([...new FormData(filters)].filter(([, value]) => value)).toString();
  if (!found || asked !== now) return; // unchanged, or the filters have changed meanwhile
  ({ rows, changes } = found);
  const left = rows.filter((row) => ["open", "stale", "no label", "old label"].includes(row[2])).length;
  find(".count").textContent = `${rows.length} trial${rows.length === 1 ? "" : "s"}, ${left} to review`;
  space.style.height = `${rows.length * ROW_PX}px`;
  drawRows();
  const mine = rows.find((row) => same(row, shown?.row));
  if (mine && String(mine) !== String(shown.row) && !deciding) await choose(mine);
}

// only the rows that can be seen are in the page
function drawRows() {
  const first = Math.max(0, Math.floor(listed.scrollTop / ROW_PX) - 4);
  const last = Math.min(rows.length, first + Math.ceil(listed.clientHeight / ROW_PX) + 8);
  space.replaceChildren(...rows.slice(first, last).map((row, i) => rowOf(row, first + i)));
  const active = space.querySelector("[aria-selected=true]");
  if (active) listed.setAttribute("aria-activedescendant", active.id);
  else listed.removeAttribute("aria-activedescendant");
  position();
}

function rowOf(row, place) {
  const made = document.createElement("div"), [campaign, trial, status, severity, reasons] = row;
  const about = { id: `row-${place}`, role: "option", "aria-posinset": place + 1, "aria-setsize": rows.length, "aria-selected": same(row, wanted) };
  for (const [key, value] of Object.entries(about)) made.setAttribute(key, value);
  made.style.top = `${place * ROW_PX}px`;
  made.title = [campaign, reasons].filter(Boolean).join(": ");
  for (const [kind, text] of [["doubt", "?".repeat(severity)], ["trial", trial], [`status ${status.replace(" ", "-")}`, status]]) {
    const cell = made.appendChild(document.createElement("span"));
    cell.className = kind;
    cell.textContent = text;
  }
  made.addEventListener("click", () => choose(row));
  return made;
}

const here = () => rows.findIndex((row) => same(row, wanted));

function position() {
  const at = rows.findIndex((row) => same(row, shown?.row)), text = find(".position");
  if (text) text.textContent = at < 0 ? "" : `${at + 1} of ${rows.length}`;
}

function step(by) {
  const at = here();
  const next = rows[at < 0 ? 0 : Math.min(Math.max(at + by, 0), rows.length - 1)];
  if (next) choose(next);
}

// one trial

async function choose(row) {
  wanted = row;
  const at = here();
  if (at >= 0) {
    const top = at * ROW_PX;
    if (top < listed.scrollTop) listed.scrollTop = top;
    else if (top + ROW_PX > listed.scrollTop + listed.clientHeight) listed.scrollTop = top + ROW_PX - listed.clientHeight;
  }
  drawRows();
  try {
    const found = await get(`/review/${path(row)}`);
    if (same(row, wanted)) show(found);
  } catch (error) { say(error.message); }
}

function show(found) {
  const again = same(found.row, shown?.row), moved = again && KINDS.some((kind) => panels.lines[`${kind}_ns`] !== shown.lines[`${kind}_ns`]);
  const kept = moved ? panels.lines : found.lines;
  shown = found;
  const parts = document.createElement("template");
  parts.innerHTML = found.html;
  for (const part of [...parts.content.children]) find(`.${part.className}`).replaceWith(part);
  position();
  // the tool's speed says nothing about a label, and the decision should be on the same screen
  found.curves.panels = found.curves.panels.filter((panel) => panel.unit !== "mm/s");
  panels.show(found.curves, kept);
  lines();
  if (form) {
    if (!again) form.elements.why.value = "";
    for (const button of form.querySelectorAll("[data-verdict]")) button.disabled = !found.able;
  }
  history.replaceState(null, "", `#${path(found.row)}`);
  frame.of(`/trials/${path(found.row)}/frame`);
  const first = found.curves.onsets.suggested.incipient_ns;
  if (found.curves.frames) frame.at({ time: first === null ? found.curves.motion : seconds(first) });
}

// where the lines are, and how far from the label
function lines() {
  const table = find(".lines"), { label, suggested } = shown.curves.onsets;
  const body = document.createElement("tbody");
  const add = (cells, kind = "") => {
    const row = body.insertRow();
    cells.forEach((text, i) => {
      const cell = row.appendChild(document.createElement(i && kind ? "td" : "th"));
      cell.textContent = text;
      if (!i || !kind) cell.scope = i ? "col" : "row";
      if (!i) cell.className = kind;
    });
  };
  const text = (ns) => ns === null ? "–" : `${seconds(ns).toFixed(4)} s`;
  add(["onset", "label", "line", "moved"]);
  for (const kind of KINDS) {
    const key = `${kind}_ns`, now = panels.lines[key], was = label[key];
    let far = "";
    if (now !== null && was !== null) {
      const ms = (seconds(BigInt(now) - BigInt(was))) * 1e3;
      far = `${ms < 0 ? "−" : "+"}${Math.abs(ms).toFixed(1)} ms`;
    } else if (was === null && now !== null && now === suggested[key]) far = "suggested from the visible markers";
    add([kind, text(was), text(now), far], kind);
  }
  table.tBodies[0]?.remove();
  table.append(body);
}

// decisions

async function decide(verdict) {
  if (!decides || deciding || !shown?.able) return;
  deciding = true;
  const [campaign, trial] = shown.row, at = here(), after = rows[at + 1];
  try {
    const answer = await fetch("/review/decision", {
      method: "POST",
      headers: { "content-type": "application/json", "x-csrf-token": root.dataset.csrf },
      body: JSON.stringify({
        campaign, trial, verdict, lines: panels.lines, label: shown.label, seen: shown.seen,
        who: form.elements.who.value, why: form.elements.why.value,
      }),
    });
    const type = answer.headers.get("content-type") ?? "";
    say(type.includes("json") ? (await answer.json()).stated : `Not saved: ${await answer.text()}`, answer.ok);
    if (!answer.ok && answer.status !== 409) return;
    // the lines are where the decision has them
    panels.lines = { ...shown.lines };
    await list();
    await choose(answer.ok && at >= 0 && after && verdict !== "reopen" && form.elements.next.checked ? after : shown.row);
  } catch (error) { say(`Not saved: ${error.message}`); } finally { deciding = false; }
}

function act(name) {
  if (name === "next" || name === "previous") step(name === "next" ? 1 : -1);
  else if (!shown) return;
  else if (name === "back" || name === "forth") frame.step(name === "forth" ? 1 : -1, shown.curves.frames);
  else if (name === "zoom") panels.zoom(panels.close ? null : frame.time);
  else if (!decides) return;
  else if (name === "reason") form.elements.why.focus();
  else if (name === "reset") { panels.place(shown.curves.onsets.suggested); lines(); }
  else if (KINDS.includes(name)) { if (frame.time !== null) panels.put(name, frame.time); }
  else decide(name);
}

window.addEventListener("keydown", (event) => {
  const target = event.target;
  if (/^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName) && target.type !== "checkbox") {
    if (event.key === "Escape") target.blur();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in KEYS)) return;
  event.preventDefault();
  act(KEYS[event.key]);
});
listed.addEventListener("scroll", drawRows);
new ResizeObserver(drawRows).observe(listed);
filters.addEventListener("submit", (event) => event.preventDefault());
filters.addEventListener("input", () => list().catch((error) => say(error.message)));
form?.addEventListener("submit", (event) => event.preventDefault());
for (const button of form?.querySelectorAll("button") ?? [])
  button.addEventListener("click", () => {
    const { verdict, put, do: name } = button.dataset;
    if (verdict) decide(verdict);
    else if (put && shown) panels.put(put, null);
    else if (name) act(name);
  });

async function look() {
  try { if (!document.hidden) await list(changes); } catch (error) { say(error.message); }
  setTimeout(look, LOOK_MS);
}

async function begin() {
  try { await list(); } catch (error) { say(error.message); }
  const asked = location.hash.slice(1).split("/").map(decodeURIComponent);
  const row = rows.find((each) => same(each, asked));
  if (row) await choose(row); else step(1);
  setTimeout(look, LOOK_MS);
}

begin();
