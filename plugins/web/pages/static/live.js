// The live page: what the server sends is put in its place.
import { KINDS, Panels, seconds } from "./plots.js";
import { localTimes } from "./page.js";

const place = (id) => document.getElementById(id);
const plots = new Panels(place("curves").querySelector(".plots"), {});
const source = new EventSource("/live");

const on = (kind, act) => source.addEventListener(kind, (event) => act(event.data));

// a part that has not changed keeps its focus and selection
for (const kind of ["now", "status"]) on(kind, (text) => {
  place(kind).innerHTML = text;
  localTimes(place(kind));
  count();
  const trial = document.querySelector("#now .id")?.textContent ?? "";
  for (const input of document.querySelectorAll("[data-trial]")) if (!input.value) input.placeholder = trial;
});
on("problem", (text) => { place("problem").textContent = text; });

// on a canvas, since a browser keeps hundreds of the pictures that an <img> has shown
async function draw(canvas, jpeg) {
  const bytes = Uint8Array.from(atob(jpeg), (letter) => letter.charCodeAt(0));
  const picture = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
  if (canvas.width !== picture.width || canvas.height !== picture.height)
    [canvas.width, canvas.height] = [picture.width, picture.height];
  canvas.getContext("2d").drawImage(picture, 0, 0);
  picture.close();
}

on("pictures", (text) => {
  const found = JSON.parse(text), parent = place("pictures"), names = Object.keys(found);
  if (names.join() !== [...parent.querySelectorAll("canvas")].map((canvas) => canvas.dataset.name).join())
    parent.replaceChildren(...names.map((name) => {
      const figure = document.createElement("figure"), canvas = document.createElement("canvas");
      canvas.dataset.name = name;
      canvas.role = "img";
      canvas.ariaLabel = `last picture of ${name}`;
      const caption = document.createElement("figcaption");
      caption.textContent = name;
      figure.append(canvas, caption);
      return figure;
    }));
  for (const canvas of parent.querySelectorAll("canvas")) draw(canvas, found[canvas.dataset.name]);
});

on("curves", (text) => {
  const trial = JSON.parse(text), [campaign, name] = trial.trial.split(" / ");
  place("curves").hidden = false;
  place("last").textContent = name;
  place("last").href = `/trials/${encodeURIComponent(campaign)}/${encodeURIComponent(name)}`;
  const known = [];
  for (const [from, both] of Object.entries(trial.onsets))
    for (const kind of KINDS)
      if (both[`${kind}_ns`] !== null) known.push(`${kind} slip at ${seconds(both[`${kind}_ns`]).toFixed(4)} s (${from})`);
  place("onsets").textContent = known.join("; ") || "No onsets are known yet: `sliplab label` finds them.";
  plots.show(trial, {});
});

// how long the trial has run, of how much it was planned for
function count() {
  for (const part of document.querySelectorAll("[data-since]")) {
    const ran = Date.now() / 1000 - Number(part.dataset.since);
    part.textContent = `${Math.max(0, ran).toFixed(0)} s of ${part.dataset.of} s planned`;
  }
}
setInterval(count, 1000);

source.onerror = () => { place("link").textContent = "The connection is lost; it is tried again."; };
source.onopen = () => { place("link").textContent = ""; };
addEventListener("pagehide", () => source.close());
