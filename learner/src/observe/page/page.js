"use strict";
// Names and numbers come from the network. They enter the page as text only, never as HTML.

const contents = JSON.parse(document.getElementById("contents").textContent);
const { progress, training, evaluations } = contents;
const SVG = "http://www.w3.org/2000/svg";
/** Seconds without a newer page after which the learner may have ended. It writes one every minute, but for a gradient step
 * that may take 900 s (LONGEST_STEP in probes.rs). */
const SILENCE = 1200;
/** Seconds between two looks at a run that goes on. */
const RELOAD = 60;
/** The colours of the rewards 0, 0.25, 0.5, 0.75 and 1: viridis, as in heat_map.rs. */
const COLOURS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
/** Pixels of a row of the heat map, as in page.css. */
const ROW = 20;

const at = (id) => document.getElementById(id);

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function shape(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const isNumber = (value) => Number.isFinite(value);
const decimal = (value, digits = 3) => (isNumber(value) ? value.toFixed(digits) : "–");
const percent = (value) => (isNumber(value) ? `${(100 * value).toFixed(0)} %` : "–");
const whole = (value) => value.toLocaleString("en");
const compact = (value) => value.toLocaleString("en", { notation: "compact", maximumFractionDigits: 2 });

function duration(seconds) {
  if (seconds < 120) return `${seconds.toFixed(0)} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 120) return `${minutes} min`;
  const hours = Math.floor(minutes / 60);
  if (hours < 48) return `${hours} h ${minutes % 60} min`;
  return `${Math.floor(hours / 24)} d ${hours % 24} h`;
}

// The tip beside the pointer.

function showTip(event, text) {
  const tip = at("tip");
  tip.textContent = text;
  tip.hidden = false;
  const { width, height } = tip.getBoundingClientRect();
  const right = event.clientX + 14 + width < innerWidth;
  tip.style.left = `${Math.max(4, right ? event.clientX + 14 : event.clientX - 14 - width)}px`;
  tip.style.top = `${Math.max(4, Math.min(event.clientY + 14, innerHeight - height - 4))}px`;
}

function hideTip() {
  at("tip").hidden = true;
}

function follow(target, move, leave = hideTip) {
  for (const name of ["pointermove", "pointerdown"]) target.addEventListener(name, move);
  target.addEventListener("pointerleave", leave);
}

// The head of the page.

function drawHead() {
  const silent = contents.state === "running" && Date.now() / 1000 - contents.written > SILENCE;
  const states = { running: "running", failed: "failed; the log says why", stopped: "stopped; may be resumed", over: "finished" };
  document.title = `${contents.run} · CoMic`;
  at("run").textContent = contents.run;
  at("name").textContent = `experiment ${contents.name}`;
  at("state").textContent = silent ? "no news; the learner may have ended" : states[contents.state];
  at("state").className = silent ? "silent" : contents.state;
  at("written").textContent = `Written by comic-learner on ${new Date(1000 * contents.written).toLocaleString()}`;
  const reward = (evaluation) => decimal(evaluation?.normalised_reward);
  const numbers = [
    ["environment steps", compact(progress.environment_steps), whole(progress.environment_steps)],
    ["updates", compact(progress.updates), whole(progress.updates)],
    ["wall-clock time", duration(progress.seconds), `${progress.seconds.toFixed(0)} s`],
    ["reward in training", decimal(training.at(-1)?.normalised_reward), "mean of the newest episodes, with noise"],
    ["newest evaluation", reward(evaluations.newest), "normalised reward"],
    ["best evaluation", reward(evaluations.best), "normalised reward"],
  ];
  at("numbers").append(
    ...numbers.map(([name, value, title]) =>
      element("div", { title }, element("dt", { textContent: name }), element("dd", { textContent: value }))),
  );
}

// The curves.

/** About `count` round numbers from `low` to `high`. */
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= rough);
  const found = [];
  for (let tick = Math.ceil(low / step); tick * step <= high * (1 + 1e-9); tick += 1) found.push(tick * step);
  return found;
}

/** The unit of an axis of time that ends at so many seconds, and its seconds. */
function timeUnit(seconds) {
  return [["d", 86400], ["h", 3600], ["min", 60]].find(([, size]) => seconds >= 2 * size) ?? ["s", 1];
}

function drawChart(figure, key, axis) {
  const [width, height] = [Math.max(figure.clientWidth, 260), 260];
  const [left, right, top, bottom] = [40, width - 12, 10, height - 40];
  const marks = evaluations.marks;
  const all = [...training, ...marks];
  if (all.length === 0) {
    figure.replaceChildren(element("div", { className: "missing", textContent: "No episode has ended yet." }));
    return;
  }
  const rewards = all.map((point) => point.normalised_reward);
  const [low, high] = [Math.min(0, ...rewards), Math.max(0.05, ...rewards) * 1.05];
  const end = Math.max(...all.map((point) => point[key]), 1);
  const x = (point) => left + (point[key] / end) * (right - left);
  const y = (reward) => bottom - ((reward - low) / (high - low)) * (bottom - top);

  const drawing = shape("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": axis.title });
  for (const tick of ticks(low, high, 5)) {
    drawing.append(
      shape("line", { class: "rule", x1: left, x2: right, y1: y(tick), y2: y(tick) }),
      shape("text", { x: left - 6, y: y(tick) + 4, "text-anchor": "end" }, String(Number(tick.toPrecision(3)))),
    );
  }
  for (const tick of ticks(0, end / axis.size, Math.max(3, Math.floor(width / 80)))) {
    const place = left + ((tick * axis.size) / end) * (right - left);
    const anchor = place > right - 16 ? "end" : "middle";
    drawing.append(shape("text", { x: place, y: bottom + 18, "text-anchor": anchor }, axis.format(tick)));
  }
  drawing.append(shape("text", { x: (left + right) / 2, y: height - 4, "text-anchor": "middle" }, axis.title));
  const path = training.map((point) => `${x(point).toFixed(1)},${y(point.normalised_reward).toFixed(1)}`);
  drawing.append(shape("polyline", { class: "curve", points: path.join(" ") }));
  const look = marks.length > 100 ? { class: "evaluation dense", r: 2.5 } : { class: "evaluation", r: 4 };
  for (const mark of marks) drawing.append(shape("circle", { ...look, cx: x(mark), cy: y(mark.normalised_reward) }));
  const cursor = shape("g", { visibility: "hidden" });
  const line = shape("line", { class: "cursor", y1: top, y2: bottom });
  const here = shape("circle", { class: "here", r: 4 });
  cursor.append(line, here);
  drawing.append(cursor);
  figure.replaceChildren(drawing);

  const nearest = (points, place) =>
    points.reduce((best, point) => (best && Math.abs(x(best) - place) <= Math.abs(x(point) - place) ? best : point), null);
  const move = (event) => {
    const box = drawing.getBoundingClientRect();
    const place = ((event.clientX - box.left) / box.width) * width;
    const trained = nearest(training, place);
    const evaluated = nearest(marks, place);
    const shown = evaluated && (!trained || Math.abs(x(evaluated) - place) < 8) ? evaluated : trained;
    cursor.setAttribute("visibility", "visible");
    line.setAttribute("x1", x(shown));
    line.setAttribute("x2", x(shown));
    here.setAttribute("cx", x(shown));
    here.setAttribute("cy", y(shown.normalised_reward));
    const texts = [`${compact(shown.environment_steps)} steps, ${duration(shown.seconds)}`];
    if (shown === evaluated) texts.push(`evaluation ${decimal(evaluated.normalised_reward)}`);
    else texts.push(`training ${decimal(trained.normalised_reward)}`);
    if (shown === evaluated && isNumber(shown.success_rate)) texts.push(`success ${percent(shown.success_rate)}`);
    showTip(event, texts.join("\n"));
  };
  follow(figure, move, () => {
    cursor.setAttribute("visibility", "hidden");
    hideTip();
  });
}

function drawCharts() {
  const last = [training.at(-1), evaluations.marks.at(-1)].map((point) => point?.seconds ?? 0);
  const [unit, size] = timeUnit(Math.max(...last));
  const steps = { title: "environment steps", size: 1, format: compact };
  const time = { title: `wall-clock time, ${unit}`, size, format: (tick) => String(Number(tick.toPrecision(3))) };
  for (const [id, key, axis] of [["over-steps", "environment_steps", steps], ["over-time", "seconds", time]]) {
    // A copy without the listeners of the chart before.
    const figure = at(id).cloneNode(false);
    at(id).replaceWith(figure);
    drawChart(figure, key, axis);
  }
}

// The films.

function drawFilm(figure, title, film) {
  const missing = () => element("div", { className: "missing", textContent: "There is no film." });
  if (!film) {
    figure.append(missing(), element("figcaption", {}, element("strong", { textContent: title })));
    return;
  }
  const picture = element("img", { src: film.path, alt: `${title}, after ${whole(film.updates)} updates` });
  picture.addEventListener("error", () => picture.replaceWith(missing()));
  const numbers = [
    `reward ${decimal(film.normalised_reward)}`,
    `success ${percent(film.success_rate)}`,
    `survived ${percent(film.fraction_survived)}`,
    `${compact(film.environment_steps)} steps`,
    `${whole(film.updates)} updates`,
  ];
  const text = ` · ${numbers.join(" · ")}`;
  figure.append(picture, element("figcaption", {}, element("strong", { textContent: title }), text));
}

function drawFilms() {
  if (!evaluations.newest_film && !evaluations.best_film) {
    at("films").remove();
    return;
  }
  drawFilm(at("newest-film"), "Newest", evaluations.newest_film);
  drawFilm(at("best-film"), "Best", evaluations.best_film);
}

// The heat map.

function colour(reward) {
  const place = reward * (COLOURS.length - 1);
  const lower = Math.min(Math.floor(place), COLOURS.length - 2);
  const channel = (index) => {
    const [from, to] = [COLOURS[lower][index], COLOURS[lower + 1][index]];
    return Math.round(from + (place - lower) * (to - from));
  };
  return `rgb(${channel(0)} ${channel(1)} ${channel(2)})`;
}

/** The normalised reward of a level from 1 to 255; `null` for 0, no result. */
const rewardOf = (level) => (level === 0 ? null : (level - 1) / 254);

function drawHeatMap() {
  const [names, columns] = [evaluations.heat_map_clips, evaluations.heat_map];
  if (names.length === 0) {
    at("clips").remove();
    return;
  }
  at("scale").style.background = `linear-gradient(90deg, ${COLOURS.map((rgb) => `rgb(${rgb.join(" ")})`).join(", ")})`;
  const height = ROW * names.length;
  const box = `0 0 ${columns.length} ${names.length}`;
  const drawing = shape("svg", { viewBox: box, height, preserveAspectRatio: "none", "shape-rendering": "crispEdges" });
  // One path for all cells of a level: a long run has 65,536 cells.
  const paths = new Map();
  columns.forEach(([, levels], column) =>
    levels.forEach((level, row) => {
      if (level > 0) paths.set(level, `${paths.get(level) ?? ""}M${column} ${row}h1v1h-1z`);
    }),
  );
  for (const [level, d] of paths) drawing.append(shape("path", { d, fill: colour(rewardOf(level)) }));
  const labels = names.map((name) => element("div", { textContent: name, title: name }));
  at("heat-map").append(element("div", { className: "names" }, ...labels), drawing);
  follow(drawing, (event) => {
    const { left, top, width } = drawing.getBoundingClientRect();
    const column = columns[Math.floor(((event.clientX - left) / width) * columns.length)];
    const row = Math.floor((event.clientY - top) / ROW);
    if (!column || names[row] === undefined) return;
    const reward = rewardOf(column[1][row]);
    const text = reward === null ? "no result" : `normalised reward ${decimal(reward, 2)}`;
    showTip(event, `${names[row]}\n${text}\nat ${compact(column[0])} steps`);
  });
}

// The tables.

function drawEvaluations() {
  const { newest, best, newest_is_best: newestIsBest } = evaluations;
  if (!newest) {
    at("evaluations").remove();
    return;
  }
  const shown = best && !newestIsBest ? [newest, best] : [newest];
  const titles = shown.length === 2 ? ["newest", "best"] : [best ? "newest and best" : "newest"];
  const of = (evaluation, index) => `${titles[index]}, ${compact(evaluation.environment_steps)} steps`;
  const heads = shown.map((evaluation, index) =>
    element("th", { colSpan: 3, className: index ? "second" : "", textContent: of(evaluation, index) }));
  const names = shown.flatMap((_, index) =>
    ["reward", "success", "survived"].map((name, column) =>
      element("th", { className: index && !column ? "second" : "", textContent: name })));
  const cells = (means, index) => [
    element("td", { className: index ? "second" : "", textContent: decimal(means?.normalised_reward) }),
    element("td", { textContent: percent(means?.success_rate) }),
    element("td", { textContent: percent(means?.fraction_survived) }),
  ];
  const row = (name, means, className) =>
    element("tr", { className }, element("td", { textContent: name, title: name }), ...means.flatMap(cells));
  const others = shown.map((evaluation) => new Map(evaluation.clips.map((clip) => [clip.name, clip])));
  const rows = [...new Set(shown.flatMap((evaluation) => evaluation.clips.map((clip) => clip.name)))];
  at("table").append(
    element("thead", {}, element("tr", {}, element("th"), ...heads),
      element("tr", {}, element("th", { textContent: "clip" }), ...names)),
    element("tbody", {}, row("all clips", shown, "all"),
      ...rows.map((name) => row(name, others.map((clips) => clips.get(name)), ""))),
  );
  if (newest.clips_left_out > 0) {
    at("left-out").textContent = `${whole(newest.clips_left_out)} more clips are in evaluations.jsonl`;
  }
}

function drawAccounting() {
  const { produced, trained, in_flight, dropped } = progress.accounting;
  const reasons = Object.entries(dropped).map(([name, unrolls]) => [`dropped: ${name.replaceAll("_", " ")}`, unrolls]);
  const all = reasons.reduce((sum, [, unrolls]) => sum + unrolls, 0);
  const parts = [["trained", trained], ["dropped", all], ["in-flight", in_flight]];
  at("shares").append(...parts.map(([className, unrolls]) => {
    const share = element("div", { className });
    share.style.flex = `${unrolls} 0 0`;
    return share;
  }));
  if (produced === 0) at("shares").remove();
  const row = (name, unrolls, key) => {
    const head = element("td", {}, ...(key ? [element("i", { className: `key ${key}` })] : []), name);
    const share = produced > 0 ? `${((100 * unrolls) / produced).toFixed(1)} %` : "–";
    return element("tr", {}, head, element("td", { textContent: whole(unrolls) }), element("td", { textContent: share }));
  };
  at("accounting").append(
    row("produced", produced),
    row("trained", trained, "trained"),
    ...reasons.map(([name, unrolls]) => row(name, unrolls, "dropped")),
    row("in flight", in_flight, "in-flight"),
  );
}

drawHead();
drawCharts();
addEventListener("resize", drawCharts);
drawFilms();
drawHeatMap();
drawEvaluations();
drawAccounting();
at("experiment").textContent = contents.experiment;
if (contents.state === "running") {
  setInterval(() => {
    if (!document.hidden && !at("details").open) location.reload();
  }, 1000 * RELOAD);
}
