// Draws the plots of a page with uPlot. The numbers come from the table of each plot, so that a page holds them once.
import { element } from "./page.js";

const LIGHT = ["#8a4b00", "#0b57d0", "#1f6b3a", "#a4161a", "#6a3fa0", "#006d77", "#5d5648", "#99004d"];
const DARK = ["#ffc25c", "#8ab4f8", "#8fd6a5", "#ff9d94", "#cfa8ff", "#6fd3dd", "#b3aa98", "#ff8fc7"];
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]];
const HEIGHT = 340;
const dark = matchMedia("(prefers-color-scheme: dark)");
const plots = new Map();

/** A number for an axis or the cursor: uPlot itself writes 0.00001 as 0. */
function written(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size < 1e-3 || size >= 1e6 ? value.toExponential(2).replace(/\.?0+e/, "e") : String(Number(value.toPrecision(4)));
}

/** Move the cursor of a plot to a row of its table. */
function moveCursor(figure, row) {
  const { plot, order } = plots.get(figure);
  const at = order.indexOf(row);
  const x = plot.data[0][at];
  plot.setCursor({ left: plot.valToPos(x, "x"), top: plot.over.clientHeight / 2 }, false);
  plot.setLegend({ idx: at }, false);
}

function tableOf(figure) {
  const table = figure.querySelector("details table");
  const heads = [...table.querySelectorAll("thead th")];
  const rows = [...table.tBodies[0].rows].map((row) => [...row.cells].map((cell) => cell.textContent));
  const number = (text) => (Number.isFinite(Number(text)) ? Number(text) : null); // "-" is no number
  const numbers = (place) => rows.map((row) => number(row[place]));
  const columns = heads.map((head, place) => ({ role: head.dataset.role, label: head.dataset.label ?? head.textContent, place }));
  const x = columns.find((column) => column.role === "x");
  const series = columns
    .filter((column) => ["line", "points"].includes(column.role))
    .map((column) => {
      const [values, sigma, low, high] = [column.role, "sigma", "low", "high"].map((role) => {
        const found = columns.find((other) => other.role === role && other.label === column.label);
        return found && numbers(found.place);
      });
      const away = (sign) => values.map((value, row) => (value === null || sigma[row] === null ? null : value + sign * sigma[row]));
      return { label: column.label, draw: column.role, values, ends: sigma ? [away(-1), away(1)] : low && high ? [low, high] : null };
    });
  return { x: numbers(x.place), xLabel: x.label, series };
}

/** The rows in the order of x, as uPlot needs them, without those that a logarithmic axis cannot show. */
function inOrder(x, log) {
  return x.map((_, place) => place).filter((place) => x[place] !== null && (!log || x[place] > 0)).sort((a, b) => x[a] - x[b]);
}

function decade(value, round) {
  return 10 ** round(Math.log10(value));
}

/** The ends of an axis, with a margin around all numbers. */
function range(rows, log) {
  const found = rows.flat().filter((value) => value !== null && (!log || value > 0));
  if (found.length === 0) return log ? [0.1, 1] : [0, 1];
  let [low, high] = [Math.min(...found), Math.max(...found)];
  if (log) {
    const least = high / 1e7; // far below that, a curve shows only rounding
    return [decade(Math.max(low, least), Math.floor), decade(high, Math.ceil)];
  }
  if (low === high) [low, high] = [low - 1, high + 1];
  const margin = (high - low) / 20;
  return [low - margin, high + margin];
}

/** Draw bands below the curves, and bars at the points. */
function drawEnds(plot, series, colours) {
  const { ctx } = plot;
  const place = (value, scale) => plot.valToPos(value, scale, true);
  const floor = plot.scales.y.min;
  ctx.save();
  ctx.beginPath();
  ctx.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height);
  ctx.clip();
  series.forEach((one, number) => {
    if (one.ends === null || !plot.series[number + 1].show) return;
    const rows = plot.data[0].map((x, at) => [x, one.ends[0][at], one.ends[1][at]]).filter(([, low, high]) => low !== null && high !== null);
    ctx.fillStyle = ctx.strokeStyle = colours[number % colours.length];
    if (one.draw === "points") {
      ctx.lineWidth = 1.5 * devicePixelRatio;
      ctx.beginPath();
      for (const [x, low, high] of rows) {
        ctx.moveTo(place(x, "x"), place(low, "y"));
        ctx.lineTo(place(x, "x"), place(high, "y"));
      }
      ctx.stroke();
      return;
    }
    ctx.globalAlpha = 0.25;
    ctx.beginPath();
    for (const [x, , high] of rows) ctx.lineTo(place(x, "x"), place(Math.max(high, floor), "y"));
    for (const [x, low] of rows.reverse()) ctx.lineTo(place(x, "x"), place(Math.max(low, floor), "y"));
    ctx.fill();
    ctx.globalAlpha = 1;
  });
  ctx.restore();
}

function draw(figure) {
  const { x, xLabel, series: unordered } = tableOf(figure);
  const [xLog, yLog] = ["xLog", "yLog"].map((name) => name in figure.dataset);
  const order = inOrder(x, xLog);
  const take = (row) => order.map((place) => row[place]);
  const series = unordered.map((one) => ({ ...one, values: take(one.values), ends: one.ends && one.ends.map(take) }));
  const colours = dark.matches ? DARK : LIGHT;
  const style = getComputedStyle(document.body);
  const ink = style.getPropertyValue("--front");
  const line = style.getPropertyValue("--line");
  const rows = series.flatMap((one) => [one.values, ...(one.ends ?? [])]);
  const axis = (label, scale, log) => ({
    label, scale, stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 },
    size: scale === "y" ? 68 : 44, labelSize: 24, values: (_, splits) => splits.map((value) => (value === null ? "" : written(value))),
    ...(log ? {} : { space: scale === "x" ? 70 : 40 }),
  });
  const value = (_, found) => written(found);
  const area = figure.querySelector(".area") ?? element("div", { class: "area", tabindex: "0", role: "group", "aria-label": `${figure.dataset.title}: arrow keys move the cursor` });
  if (!area.isConnected) figure.querySelector("details").before(area);
  area.replaceChildren();
  plots.get(figure)?.plot.destroy();
  const plot = new uPlot(
    {
      width: area.clientWidth, height: HEIGHT,
      scales: { x: { time: false, distr: xLog ? 3 : 1, range: () => xLog ? [order.length ? x[order[0]] : 1, order.length ? x[order.at(-1)] : 10] : range([take(x)], false) }, y: { distr: yLog ? 3 : 1, range: () => range(rows, yLog) } },
      axes: [axis(xLabel, "x", xLog), axis(figure.dataset.y, "y", yLog)],
      cursor: { drag: { x: false, y: false }, points: { size: 8 } },
      series: [
        { label: xLabel, value },
        ...series.map((one, number) => ({
          label: one.label, value, stroke: colours[number % colours.length], width: 2, spanGaps: true,
          dash: one.draw === "line" ? DASHES[Math.floor(number / colours.length + number) % DASHES.length] : [],
          ...(one.draw === "points" ? { paths: () => null, points: { show: true, size: 7, fill: number === 0 ? colours[0] : "transparent" } } : { points: { show: false } }),
        })),
      ],
      hooks: {
        drawAxes: [(made) => drawEnds(made, series, colours)],
        setCursor: [(made) => figure.dispatchEvent(new CustomEvent("plot-cursor", { detail: made.cursor.idx === null || made.cursor.idx === undefined ? null : order[made.cursor.idx] }))],
      },
    },
    [take(x), ...series.map((one) => one.values)],
    area,
  );
  const canvas = plot.root.querySelector("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `${figure.dataset.title}: ${figure.dataset.y} against ${xLabel}. The table below holds the numbers.`);
  area.onkeydown = (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    const at = Math.min(Math.max((plot.cursor.idx ?? -1) + step, 0), order.length - 1);
    moveCursor(figure, order[at]);
    figure.dispatchEvent(new CustomEvent("plot-cursor", { detail: order[at] }));
  };
  plots.set(figure, { plot, order });
}

const figures = [...document.querySelectorAll("[data-plot]")];
for (const figure of figures) draw(figure);
dark.addEventListener("change", () => figures.forEach(draw));
addEventListener("resize", () => {
  for (const figure of figures) plots.get(figure).plot.setSize({ width: figure.querySelector(".area").clientWidth, height: HEIGHT });
});

/** Link the map of discs with the plot of their residuals: a slider, the map and the plot choose the same disc. */
function linkDiscs(place) {
  const figure = place.querySelector("[data-plot]");
  const slider = document.getElementById("gap-disc");
  const told = document.getElementById("gap-told");
  const discs = new Map([...place.querySelectorAll("circle")].map((disc) => [Number(disc.dataset.row), disc]));

  function choose(row) {
    for (const disc of place.querySelectorAll("circle.chosen")) disc.classList.remove("chosen");
    discs.get(row).classList.add("chosen");
    slider.value = row;
    told.textContent = discs.get(row).dataset.told;
  }

  document.getElementById("gap-choice").hidden = false;
  slider.addEventListener("input", () => {
    choose(Number(slider.value));
    moveCursor(figure, Number(slider.value));
  });
  for (const [row, disc] of discs) {
    disc.addEventListener("pointerenter", () => {
      choose(row);
      moveCursor(figure, row);
    });
  }
  figure.addEventListener("plot-cursor", (event) => event.detail !== null && choose(event.detail));
  choose(0);
}

const gap = document.getElementById("gap");
if (gap !== null) linkDiscs(gap);
