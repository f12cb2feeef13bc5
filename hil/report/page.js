"use strict";
// Hovering shows the values of a chart's curves at the pointer; dragging zooms in time; with Shift, dragging or the wheel moves
// along the time axis; double-click or a button shows the whole range again; another button saves the chart as it is shown.
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const text = (value) => Number(value.toPrecision(4)).toString().replace("-", "\u2212");

  function element(name, attributes, parent) {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    parent.append(made);
    return made;
  }

  // Ticks at 1, 2 or 5 times a power of ten, about 70 pixels apart, as in hil.report.scale.
  function ticks(low, high, pixels) {
    const raw = (high - low) / Math.max(2, pixels / 70);
    const size = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((factor) => factor * size).find((one) => one >= raw * (1 - 1e-9));
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k <= Math.floor(high / step + 1e-9); k++) found.push(k * step);
    return found;
  }

  function enliven(svg) {
    const [xLow, xHigh, xStart, xEnd] = svg.dataset.x.split(" ").map(Number);
    const [yLow, yHigh, yStart, yEnd] = svg.dataset.y.split(" ").map(Number);
    const log = svg.dataset.log === "1";
    const plot = svg.querySelector(".plot");
    const axis = svg.querySelector(".x-axis");
    const originalAxis = axis.innerHTML;
    const figure = svg.parentNode;
    let shown = [xStart, xEnd]; // the part of the plot, in its own pixels, that fills the chart
    let from = null; // start of the range being selected
    let held = null; // pointer position from which the plot is being moved
    let chosen = null;
    let curves = null;

    const value = (pixel) => xLow + ((pixel - xStart) / (xEnd - xStart)) * (xHigh - xLow);
    const height = (pixel) => {
      const part = (pixel - yStart) / (yEnd - yStart);
      return log ? yLow * (yHigh / yLow) ** part : yLow + part * (yHigh - yLow);
    };
    const inPlot = (pixel) => shown[0] + ((pixel - xStart) / (xEnd - xStart)) * (shown[1] - shown[0]);
    const onScreen = (pixel) => xStart + ((pixel - shown[0]) / (shown[1] - shown[0])) * (xEnd - xStart);

    // Read from the paths when first needed, so that opening the page costs nothing.
    function read() {
      curves ??= [...plot.querySelectorAll('path:not([data-kind="area"])')].map((path) => ({
        name: path.dataset.name,
        points: [...path.getAttribute("d").matchAll(/(-?[\d.]+),(-?[\d.]+)/g)].map((pair) => [+pair[1], +pair[2]]),
      }));
      return curves;
    }

    function pointer(event) {
      const box = svg.getBoundingClientRect();
      const scale = svg.viewBox.baseVal.width / box.width;
      return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale, scale];
    }

    function clear() {
      svg.querySelector(".cursor")?.remove();
      figure.querySelector(".reading")?.remove();
    }

    function hover(event) {
      clear();
      const [across, up, scale] = pointer(event);
      if (across < xStart || across > xEnd || up > yStart || up < yEnd) return;
      element("line", { class: "cursor", x1: across, x2: across, y1: yStart, y2: yEnd }, svg);
      const at = inPlot(across);
      const lines = [text(value(at))];
      for (const { name, points } of read()) {
        if (!name || !points.length) continue;
        const near = points.reduce((best, point) => (Math.abs(point[0] - at) < Math.abs(best[0] - at) ? point : best));
        lines.push(`${name}: ${text(height(near[1]))}`);
      }
      const reading = document.createElement("div");
      reading.className = "reading";
      for (const line of lines) reading.append(line, document.createElement("br"));
      figure.append(reading);
      const left = across / scale;
      const room = figure.clientWidth - reading.offsetWidth;
      reading.style.left = `${Math.max(0, Math.min(room, left + 12 > room ? left - reading.offsetWidth - 12 : left + 12))}px`;
      reading.style.top = `${svg.offsetTop + yEnd / scale + 6}px`;
    }

    function show(low, high) {
      shown = [low, high];
      const factor = (xEnd - xStart) / (high - low);
      plot.setAttribute("transform", `translate(${xStart - low * factor} 0) scale(${factor} 1)`);
      figure.querySelector(".back")?.remove();
      if (low === xStart && high === xEnd) {
        axis.innerHTML = originalAxis;
        return;
      }
      axis.replaceChildren();
      for (const tick of ticks(value(low), value(high), xEnd - xStart)) {
        const at = onScreen(xStart + ((tick - xLow) / (xHigh - xLow)) * (xEnd - xStart));
        element("line", { x1: at, x2: at, y1: yStart, y2: yEnd, stroke: "#e3e6ea" }, axis);
        element("text", { x: at, y: yStart + 16, "text-anchor": "middle" }, axis).textContent = text(tick);
      }
      const back = document.createElement("button");
      back.className = "back";
      back.textContent = "Whole range";
      back.onclick = () => show(xStart, xEnd);
      figure.append(back);
    }

    function move(pixels) {
      const width = shown[1] - shown[0];
      const low = Math.min(xEnd - width, Math.max(xStart, shown[0] - (pixels * width) / (xEnd - xStart)));
      show(low, low + width);
    }

    const save = document.createElement("button");
    save.className = "save";
    save.textContent = "Save";
    save.title = "Save this chart as SVG";
    save.onclick = () => {
      clear();
      const link = document.createElement("a");
      link.download = `${figure.id.replace("figure-", "")}.svg`;
      link.href = URL.createObjectURL(new Blob([new XMLSerializer().serializeToString(svg)], { type: "image/svg+xml" }));
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    };
    if (svg.getBoundingClientRect().width) figure.append(save);

    svg.addEventListener("wheel", (event) => {
      if (!event.shiftKey) return; // the page scrolls
      event.preventDefault();
      move(-(event.deltaX || event.deltaY));
    }, { passive: false });
    svg.addEventListener("pointermove", (event) => {
      hover(event);
      if (held !== null) {
        const across = pointer(event)[0];
        move(across - held);
        held = across;
      }
      if (from === null) return;
      const to = Math.min(xEnd, Math.max(xStart, pointer(event)[0]));
      chosen ??= element("rect", { class: "chosen", y: yEnd, height: yStart - yEnd }, svg);
      chosen.setAttribute("x", Math.min(from, to));
      chosen.setAttribute("width", Math.abs(to - from));
    });
    svg.addEventListener("pointerdown", (event) => {
      const [across] = pointer(event);
      if (event.pointerType === "mouse" && across >= xStart && across <= xEnd) {
        if (event.shiftKey) held = across;
        else from = across;
        svg.setPointerCapture(event.pointerId);
        event.preventDefault();
      } else hover(event);
    });
    svg.addEventListener("pointerup", (event) => {
      if (from !== null) {
        const to = Math.min(xEnd, Math.max(xStart, pointer(event)[0]));
        if (Math.abs(to - from) > 8) show(inPlot(Math.min(from, to)), inPlot(Math.max(from, to)));
      }
      from = held = null;
      chosen?.remove();
      chosen = null;
    });
    svg.addEventListener("pointerleave", clear);
    svg.addEventListener("dblclick", () => show(xStart, xEnd));
  }

  document.querySelectorAll("svg[data-x]").forEach(enliven);
})();

// The arm: played in real time, or placed by the slider or by dragging across it.
for (const figure of document.querySelectorAll("figure.motion")) {
  const angles = JSON.parse(figure.dataset.angles), lengths = JSON.parse(figure.dataset.lengths);
  const interval = Number(figure.dataset.interval), frames = angles[0].length;
  const svg = figure.querySelector("svg"), links = figure.querySelector(".links"), joints = figure.querySelector(".joints");
  const [button, slider, shown] = ["button", "input", "output"].map((name) => figure.querySelector(name));
  const scale = 100 / lengths.reduce((sum, length) => sum + length, 0);
  let started = null;

  function show(frame) {
    let x = 0, y = 0, angle = 0;
    const points = [[0, 0]];
    lengths.forEach((length, joint) => {
      angle += angles[joint][frame];
      x += scale * length * Math.cos(angle);
      y -= scale * length * Math.sin(angle);
      points.push([x, y]);
    });
    links.setAttribute("points", points.map((point) => point.map((one) => one.toFixed(1)).join(",")).join(" "));
    joints.innerHTML = points.slice(0, -1).map(([cx, cy]) => `<circle cx="${cx.toFixed(1)}" cy="${cy.toFixed(1)}" r="5"/>`).join("");
    slider.value = frame;
    shown.textContent = `${(frame * interval).toFixed(2)} s`;
  }
  function play(now) {
    if (started === null) return;
    show(Math.floor((now - started) / 1000 / interval) % frames);
    requestAnimationFrame(play);
  }
  function stop() { started = null; button.textContent = "Play"; }
  button.addEventListener("click", () => {
    if (started !== null) { stop(); return; }
    started = performance.now() - 1000 * interval * Number(slider.value);
    button.textContent = "Pause";
    requestAnimationFrame(play);
  });
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  svg.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    stop();
    const box = svg.getBoundingClientRect();
    const part = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    show(Math.round(part * (frames - 1)));
  });
  show(0);
}
