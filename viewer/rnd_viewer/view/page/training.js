// The page of a training: content of the run's folder, requested every two seconds.

const PERIOD_MS = 2000, SILENT_S = 120;
const WIDTH = 300, HEIGHT = 70;  // of a curve, in its own units
const $ = (id) => document.getElementById(id);
let previews = [], latest = true;

function duration(seconds) {
  const s = Math.max(Math.round(seconds), 0), h = Math.floor(s / 3600), m = Math.floor(s % 3600 / 60);
  return h ? `${h} h ${m} min` : m ? `${m} min ${s % 60} s` : `${s} s`;
}

function show(run) {
  const percent = Math.floor(100 * run.done / run.total);
  document.title = `${run.ended ?? `${percent} %`} · ${run.name}`;
  $("title").textContent = run.name;
  $("subtitle").textContent = run.ended === "stopped" ? "stopped; rnd-train --resume continues" : run.ended ?? run.phase ?? "";
  $("progress").value = run.done / run.total;
  rows({
    step: `${run.done} of ${run.total}`,
    trained: duration(run.seconds),
    "time left": run.ended || run.seconds_left === null ? "–" : duration(run.seconds_left),
    "steps skipped (not finite)": run.skipped || null,
  });
  const silent = !run.ended && run.silent_s > SILENT_S;
  $("notes").textContent = silent ? `nothing written for ${duration(run.silent_s)}: is rnd-train still running?` : "";
  $("avatar").hidden = !run.avatar;
  $("curves").replaceChildren(...Object.entries(run.curves).map(([name, points]) => curve(name, points)));
  previews = run.previews;
  $("step").disabled = previews.length < 2;
  $("step").max = Math.max(previews.length - 1, 0);
  if (latest) $("step").value = $("step").max;
  showPreview();
  say(run.done || run.ended ? "" : `${run.phase ?? "waiting for the first step"} …`);
}

function rows(facts) {
  $("facts").replaceChildren(...Object.entries(facts).filter(([, value]) => value !== null).map((cells) => {
    const row = document.createElement("tr");
    for (const text of cells) row.appendChild(document.createElement("td")).textContent = text;
    return row;
  }));
}

/** A figure of `points` [[step, value], …] over the logarithm of the positive values. */
function curve(name, points) {
  const shown = points.filter(([, value]) => value > 0).map(([step, value]) => [step, Math.log10(value)]);
  const logs = shown.map(([, log]) => log), low = Math.min(...logs), span = Math.max(Math.max(...logs) - low, 0.05);
  const last = Math.max(points.at(-1)[0], 1);
  const path = shown.map(([step, log], k) =>
    `${k ? "L" : "M"}${(WIDTH * step / last).toFixed(1)} ${(HEIGHT - 3 - (HEIGHT - 6) * (log - low) / span).toFixed(1)}`);
  const figure = document.createElement("figure"), svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  svg.setAttribute("preserveAspectRatio", "none");
  svg.appendChild(document.createElementNS(svg.namespaceURI, "path")).setAttribute("d", path.join(""));
  const caption = document.createElement("p");
  for (const text of [name, points.at(-1)[1].toPrecision(3)]) caption.appendChild(document.createElement("span")).textContent = text;
  figure.append(caption, svg);
  return figure;
}

function showPreview() {
  const name = previews[Number($("step").value)];
  $("preview").hidden = !name;
  $("clock").textContent = name ? `step ${Number(name.match(/\d+/)[0])}` : "–";
  if (name && $("preview").getAttribute("src") !== `previews/${name}`) $("preview").src = `previews/${name}`;
}

function say(text, wrong = false) {
  $("message").textContent = text;
  $("message").classList.toggle("wrong", wrong);
}

$("step").addEventListener("input", () => {
  latest = $("step").value === $("step").max;
  showPreview();
});

for (;;) {
  try {
    show(await (await fetch("training.json")).json());
  } catch {
    say("rnd-view does not answer; is it still running?", true);
  }
  await new Promise((done) => { setTimeout(done, PERIOD_MS); });
}
