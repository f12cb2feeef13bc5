// A spatial arm: links are placed from the joint angles, projected, and drawn from back to front. Drag or use the arrow keys
// to turn it; colours show where the arm comes close to something or to a position limit.
for (const figure of document.querySelectorAll("figure.spatial")) {
  const scene = JSON.parse(figure.dataset.scene), frames = scene.angles[0].length;
  const svg = figure.querySelector("svg"), ranges = figure.querySelector(".ranges"), said = figure.querySelector(".nearest");
  const [button, slider, shown] = ["button", "input", "output"].map((name) => figure.querySelector(name));
  const ABOUT_M = 0.02, ABOUT_LIMIT = 0.05; // excess clearance, and fraction of the range, below which they are marked
  const FIRST = { yaw: -0.9, pitch: 0.35 };
  let view = { ...FIRST }, frame = 0, started = null, held = null;

  const product = (m, v) => [0, 3, 6].map((row) => m[row] * v[0] + m[row + 1] * v[1] + m[row + 2] * v[2]);
  const matrix = (a, b) => [0, 3, 6].flatMap((row) =>
    [0, 1, 2].map((column) => a[row] * b[column] + a[row + 1] * b[column + 3] + a[row + 2] * b[column + 6]));
  const sum = (a, b) => a.map((value, k) => value + b[k]);
  function about([x, y, z], angle) {
    const c = Math.cos(angle), s = Math.sin(angle), t = 1 - c;
    return [c + t * x * x, t * x * y - s * z, t * x * z + s * y, t * x * y + s * z, c + t * y * y, t * y * z - s * x,
      t * x * z - s * y, t * y * z + s * x, c + t * z * z];
  }

  // Rotation and origin of the base and of every link, in the upright frame.
  function placed(at) {
    const found = [[scene.upright, [0, 0, 0]]];
    scene.chain.forEach((joint, k) => {
      const [turn, origin] = found[k];
      const here = sum(origin, product(turn, joint.slice(9, 12)));
      found.push([matrix(matrix(turn, joint.slice(0, 9)), about(joint.slice(12, 15), scene.angles[k][at])), here]);
    });
    return found;
  }

  // Pixels to the right and down, and distance towards the viewer [m].
  function project(point) {
    const [x, y, z] = point.map((value, k) => value - scene.centre[k]);
    const c = Math.cos(view.yaw), s = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const scale = 100 / scene.reach;
    return [scale * (c * y - s * x), -scale * (cp * z - sp * (c * x + s * y)), cp * (c * x + s * y) + sp * z];
  }

  const shade = (room) => (room < 0 ? "near" : room < 1e3 * ABOUT_M ? "about" : "free");
  function shadeOfLimit(angle, [low, high]) {
    if (angle < low || angle > high) return "near";
    return Math.min(angle - low, high - angle) < ABOUT_LIMIT * (high - low) ? "about" : "free";
  }
  const line = (a, b, kind, width) =>
    `<path class="${kind}" d="M${a[0].toFixed(1)},${a[1].toFixed(1)}L${(b[0] + 0.01).toFixed(2)},${b[1].toFixed(1)}"` +
    (width ? ` stroke-width="${width.toFixed(1)}"/>` : "/>");

  function floor() {
    if (scene.floor === null) return "";
    const lines = [], size = scene.reach, [x, y] = scene.centre, z = scene.floor;
    for (let k = -4; k <= 4; k++) {
      const at = (k / 4) * size;
      lines.push(line(project([x + at, y - size, z]), project([x + at, y + size, z]), "grid"));
      lines.push(line(project([x - size, y + at, z]), project([x + size, y + at, z]), "grid"));
    }
    return lines.join("");
  }

  function boxes() {
    const found = [];
    for (const box of scene.boxes) {
      const turn = box.slice(0, 9), centre = box.slice(9, 12), half = box.slice(12, 15);
      const corner = (signs) => project(product(scene.upright, sum(centre, product(turn, signs.map((sign, k) => sign * half[k])))));
      for (const axis of [0, 1, 2]) for (const sign of [-1, 1]) {
        const [p, q] = [0, 1, 2].filter((k) => k !== axis);
        const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => {
          const signs = [0, 0, 0];
          signs[axis] = sign; signs[p] = a; signs[q] = b;
          return corner(signs);
        });
        const depth = corners.reduce((total, each) => total + each[2], 0) / 4;
        const points = corners.map((each) => `${each[0].toFixed(1)},${each[1].toFixed(1)}`).join(" ");
        found.push([depth, `<polygon class="box" points="${points}"/>`]);
      }
    }
    return found;
  }

  function draw() {
    const frames_ = placed(frame), pair = scene.pairs[scene.nearest[frame]], kind = shade(scene.room[frame]);
    const scale = 100 / scene.reach;
    const parts = boxes();
    for (const each of scene.capsules) {
      const [turn, origin] = frames_[each.link];
      const [a, b] = [0, 3].map((k) => project(sum(origin, product(turn, each.ends.slice(k, k + 3)))));
      const colour = kind !== "free" && pair.includes(each.name) ? kind : each.link === 0 ? "base" : each.link % 2 ? "odd" : "even";
      const width = Math.max(2, 2 * scale * each.radius);
      parts.push([(a[2] + b[2]) / 2, line(a, b, "edge", width + 1.2) + line(a, b, colour, width)]);
    }
    scene.chain.forEach((_, k) => {
      const [x, y, depth] = project(frames_[k + 1][1]);
      const colour = shadeOfLimit(scene.angles[k][frame], scene.limits[k]);
      parts.push([depth + 1e-3 + scene.reach * 0.05, `<circle class="joint ${colour}" cx="${x.toFixed(1)}" cy="${y.toFixed(1)}" r="2.6"/>`]);
    });
    parts.sort((one, other) => one[0] - other[0]);
    svg.innerHTML = floor() + parts.map((part) => part[1]).join("");
    said.className = `nearest ${kind}`;
    said.textContent = pair[0] === "nothing" ? "" : `nearest: ${pair[0]} and ${pair[1]}, ${scene.clearance[frame]} mm`;
    [...ranges.children].forEach((row, k) => {
      const angle = scene.angles[k][frame], [low, high] = scene.limits[k];
      row.className = shadeOfLimit(angle, scene.limits[k]);
      row.querySelector("i").style.left = `${100 * Math.min(1, Math.max(0, (angle - low) / (high - low)))}%`;
      row.querySelector("b").textContent = `${((180 / Math.PI) * angle).toFixed(0).replace(/^-0$/, "0").replace("-", "\u2212")}\u00b0`;
    });
    slider.value = frame;
    shown.textContent = `${(frame * scene.interval).toFixed(2)} s`;
  }

  for (const name of scene.names) {
    const row = document.createElement("div"), label = document.createElement("span"), bar = document.createElement("u");
    label.textContent = name;
    bar.append(document.createElement("i"));
    row.append(label, bar, document.createElement("b"));
    ranges.append(row);
  }
  function show(at) { frame = at; draw(); }
  function play(now) {
    if (started === null) return;
    show(Math.floor((now - started) / 1000 / scene.interval) % frames);
    requestAnimationFrame(play);
  }
  function stop() { started = null; button.textContent = "Play"; }
  function turn(yaw, pitch) {
    view = { yaw: view.yaw + yaw, pitch: Math.min(1.57, Math.max(-0.3, view.pitch + pitch)) };
    if (started === null) draw();
  }
  button.addEventListener("click", () => {
    if (started !== null) { stop(); return; }
    started = performance.now() - 1000 * scene.interval * frame;
    button.textContent = "Pause";
    requestAnimationFrame(play);
  });
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  svg.addEventListener("pointerdown", (event) => {
    held = [event.clientX, event.clientY];
    svg.classList.add("held"); // no focus frame for a pointer
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (held === null) return;
    turn(-0.01 * (event.clientX - held[0]), 0.01 * (event.clientY - held[1]));
    held = [event.clientX, event.clientY];
  });
  for (const type of ["pointerup", "pointercancel"]) svg.addEventListener(type, () => { held = null; });
  svg.addEventListener("dblclick", () => { view = { ...FIRST }; draw(); });
  svg.addEventListener("keydown", (event) => {
    const turned = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (!turned) return;
    event.preventDefault();
    svg.classList.remove("held");
    turn(...turned);
  });
  draw();
}
