// Times of the server are UTC: show those of this browser.
export function localTimes(parent) {
  for (const time of parent.querySelectorAll("time[datetime]")) {
    const moment = new Date(time.dateTime);
    if (Number.isNaN(moment.valueOf())) continue;
    time.title = time.dateTime;
    time.textContent = moment.toLocaleString(undefined, { dateStyle: "medium", timeStyle: "medium" });
  }
}
localTimes(document);

// A page that is not complete yet loads itself again, once nobody fills in its form.
function loadAgain() {
  if (document.querySelector("form :focus")) setTimeout(loadAgain, 1000);
  else location.reload();
}
if (document.querySelector("[data-reading]")) setTimeout(loadAgain, 1000);
