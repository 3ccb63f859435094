// Drawing of the arm: measured and predicted motion, rotation by the pointer or the arrow keys, highlighted joints.
"use strict";
const arm = (() => {
  const canvas = document.querySelector("canvas.arm");
  const told = document.getElementById("scene");
  if (!canvas || !told) return null;
  const scene = JSON.parse(told.textContent);
  const millimetres = (point) => point.map((x) => 1000 * x);
  for (const link of scene.links) Object.assign(link, {
    R: link.rotation.flat(), p: millimetres(link.position), v: link.shape.vertices.map(millimetres), f: link.shape.faces,
  });
  const context = canvas.getContext("2d");
  const state = { motion: 0, time: 0, playing: false, yaw: 2.3, pitch: 0.36, lit: null };
  const LIGHT = [-0.352, 0.624, 0.704];
  let ink = {};
  const readColours = () => {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["arm", "model", "lit", "low", "high", "ground"]) {
      ink[name] = rgb(style.getPropertyValue("--arm-" + name).trim());
    }
  };
  const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
  const mix = (a, b, part) => a.map((x, k) => x + (b[k] - x) * part);

  // 3 x 3 matrices in row-major order
  const times = (A, B) => {
    const C = new Array(9);
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) {
      C[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j];
    }
    return C;
  };
  const apply = (A, v) => [0, 3, 6].map((k) => A[k] * v[0] + A[k + 1] * v[1] + A[k + 2] * v[2]);
  const turn = ([x, y, z], angle) => {
    const c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
    return [c + x * x * d, x * y * d - z * s, x * z * d + y * s,
            y * x * d + z * s, c + y * y * d, y * z * d - x * s,
            z * x * d - y * s, z * y * d + x * s, c + z * z * d];
  };
  const frames = (q) => {
    const placed = [];
    for (const link of scene.links) {
      const above = link.parent < 0 ? { R: [1, 0, 0, 0, 1, 0, 0, 0, 1], p: [0, 0, 0] } : placed[link.parent];
      const moved = apply(above.R, link.p);
      let R = times(above.R, link.R), p = above.p.map((x, k) => x + moved[k]);
      const value = link.offset + (link.joint < 0 ? 0 : link.ratio * q[link.joint]);
      if (link.slides) {
        const along = apply(R, link.axis);
        p = p.map((x, k) => x + 1000 * value * along[k]);
      } else R = times(R, turn(link.axis, value));
      placed.push({ R, p });
    }
    return placed;
  };
  const camera = () => {
    const c = Math.cos(state.yaw), s = Math.sin(state.yaw), cp = Math.cos(state.pitch), sp = Math.sin(state.pitch);
    return [-c, s, 0, -s * sp, -c * sp, cp, s * cp, c * cp, sp];
  };

  // view of a motion: centre and ground level below all links [mm], pixels per metre
  const view = (motion) => {
    const eye = camera(), low = [0, 0, 0], high = [0, 0, 0];
    let ground = 0;
    // the extent of a motion is approximated by a dozen poses
    const stride = Math.max(1, Math.floor(motion.q.length / 12));
    for (let row = 0; row < motion.q.length; row += stride) frames(motion.q[row]).forEach(({ R, p }, index) => {
      ground = Math.min(ground, p[2]);
      for (const v of scene.links[index].v) {
        const w = apply(R, v);
        apply(eye, w.map((x, k) => x + p[k])).forEach((x, k) => {
          low[k] = Math.min(low[k], x);
          high[k] = Math.max(high[k], x);
        });
      }
    });
    const scale = 860 * Math.min(640 / (high[0] - low[0] || 1), 420 / (high[1] - low[1] || 1));
    // the view is centred on the projected picture, not on the arm's box, so that an oblique arm fills the frame
    const [x, y, z] = low.map((least, k) => (least + high[k]) / 2);
    return { middle: [0, 1, 2].map((k) => eye[k] * x + eye[3 + k] * y + eye[6 + k] * z), scale, ground };
  };
  for (const motion of scene.motions) Object.assign(motion, view(motion));

  // linear interpolation of the rows of a motion at the current time
  const at = (motion, rows) => {
    const t = motion.t;
    let k = 0;
    while (k < t.length - 2 && t[k + 1] < state.time) k++;
    const part = Math.min(1, Math.max(0, (state.time - t[k]) / (t[k + 1] - t[k] || 1)));
    return rows[k].map((x, j) => (x === null || rows[k + 1][j] === null ? NaN : x + part * (rows[k + 1][j] - x)));
  };
  const polygons = (q, eye, paint, moving) => {
    const middle = scene.motions[state.motion].middle;
    const found = [];
    frames(q).forEach(({ R, p }, index) => {
      const link = scene.links[index];
      if (moving && carried(link) < 0) return;
      const flat = link.v.map((v) => {
        const w = apply(R, v);
        return apply(eye, w.map((x, k) => x + p[k] - middle[k]));
      });
      for (const face of link.f) {
        const [a, b, c] = [flat[face[0]], flat[face[1]], flat[face[2]]];
        const u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]], w = [c[0] - b[0], c[1] - b[1], c[2] - b[2]];
        const n = [u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]];
        const norm = Math.hypot(...n);
        // back faces are drawn for open or inverted meshes; not for the translucent predicted arm, where they would show
        if (norm === 0 || (moving && n[2] <= 0)) continue;
        const front = n[2] < 0 ? -1 : 1;
        const shade = Math.max(0, front * (n[0] * LIGHT[0] + n[1] * LIGHT[1] + n[2] * LIGHT[2]) / norm);
        let depth = 0;
        for (const k of face) depth += flat[k][2];
        found.push({ depth: depth / face.length, corners: face.map((k) => flat[k]), colour: paint(link, shade) });
      }
    });
    return found;
  };
  const css = (colour, alpha) => `rgba(${colour.map(Math.round).join(",")},${alpha})`;
  const carried = (link) => { // index of the joint above a link, beyond fixed links
    while (link.joint < 0 && link.parent >= 0) link = scene.links[link.parent];
    return link.joint;
  };
  const draw = () => {
    const motion = scene.motions[state.motion];
    const wide = canvas.clientWidth, high = canvas.clientHeight, dense = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(wide * dense)) {
      canvas.width = Math.round(wide * dense);
      canvas.height = Math.round(high * dense);
    }
    const size = motion.scale * Math.min(wide / 640, high / 420);
    const eye = camera();
    const values = motion.error && at(motion, motion.error);
    const measured = (link, shade) => {
      const joint = carried(link);
      let base = ink.arm;
      if (state.lit) base = state.lit.includes(joint) ? ink.lit : ink.arm;
      else if (values && joint >= 0 && Number.isFinite(values[joint])) {
        base = mix(ink.low, ink.high, Math.min(1, Math.max(0, values[joint])));
      }
      return css(base.map((x) => x * (0.55 + 0.45 * shade)), 1);
    };
    const q = at(motion, motion.q);
    const there = motion.predicted && at(motion, motion.predicted);
    const pale = (link, shade) => css(mix(ink.model, [255, 255, 255], 0.3 * shade), 0.34);
    const nearer = (a, b) => a.depth - b.depth;
    const drawn = polygons(q, eye, measured).sort(nearer);
    if (there && there.every(Number.isFinite)) drawn.push(...polygons(there, eye, pale, true).sort(nearer));
    context.setTransform(dense, 0, 0, dense, 0, 0);
    context.clearRect(0, 0, wide, high);
    context.lineJoin = "round";
    ground(eye, size, wide, high);
    for (const { corners, colour } of drawn) {
      context.beginPath();
      for (const [x, y] of corners) context.lineTo(wide / 2 + size * x / 1000, high / 2 - size * y / 1000);
      context.closePath();
      context.fillStyle = context.strokeStyle = colour;
      context.lineWidth = 0.6;
      context.fill();
      if (!colour.endsWith(",0.34)")) context.stroke();
    }
    report(motion);
  };
  const ground = (eye, size, wide, high) => {
    const { middle, ground: z } = scene.motions[state.motion], step = 1000 * scene.extent / 4;
    context.strokeStyle = css(ink.ground, 1);
    context.lineWidth = 1;
    context.beginPath();
    for (let k = -4; k <= 4; k++) for (const ends of [[[k, -4], [k, 4]], [[-4, k], [4, k]]]) {
      ends.forEach(([x, y], first) => {
        const p = apply(eye, [x * step - middle[0], y * step - middle[1], z - middle[2]]);
        const point = [wide / 2 + size * p[0] / 1000, high / 2 - size * p[1] / 1000];
        if (first === 0) context.moveTo(...point); else context.lineTo(...point);
      });
    }
    context.stroke();
  };

  const clock = document.getElementById("arm-time"), slider = document.getElementById("arm-slider");
  const play = document.getElementById("arm-play");
  const report = (motion) => {
    const end = motion.t[motion.t.length - 1];
    clock.textContent = `${state.time.toFixed(2)} of ${end.toFixed(2)} s`;
    slider.max = end;
    slider.value = state.time;
    for (const chart of document.querySelectorAll("svg.chart[data-motion]")) {
      const own = chart.dataset.motion === motion.name;
      let line = chart.querySelector(".cursor");
      if (!line && own) {
        line = document.createElementNS("http://www.w3.org/2000/svg", "path");
        line.setAttribute("class", "cursor");
        chart.append(line);
      }
      if (!line) continue;
      const [start, stop, low, high] = chart.dataset.x.split(" ").map(Number);
      const [bottom, top] = chart.dataset.y.split(" ").map(Number);
      const x = start + (stop - start) * (state.time - low) / (high - low);
      line.setAttribute("d", own && state.time > 0 ? `M${x.toFixed(1)} ${bottom}V${top}` : "");
    }
  };
  let before = null;
  const tick = (now) => {
    if (!state.playing) return;
    const end = scene.motions[state.motion].t.at(-1);
    if (before !== null) state.time += (now - before) / 1000;
    before = now;
    if (state.time > end) state.time = 0;
    draw();
    requestAnimationFrame(tick);
  };
  const run = (playing) => {
    state.playing = playing;
    play.textContent = playing ? "Pause" : "Play";
    play.setAttribute("aria-pressed", playing);
    before = null;
    if (playing) requestAnimationFrame(tick); else draw();
  };
  play.addEventListener("click", () => run(!state.playing));
  slider.addEventListener("input", () => { state.time = Number(slider.value); run(false); });
  const choose = document.getElementById("arm-motion");
  choose?.addEventListener("change", () => { state.motion = Number(choose.value); state.time = 0; draw(); });
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.08], ArrowDown: [0, -0.08] }[event.key];
    if (turns) { state.yaw += turns[0]; state.pitch = Math.min(1.5, Math.max(-1.5, state.pitch + turns[1])); draw(); }
    else if (event.key === " ") run(!state.playing);
    else return;
    event.preventDefault();
  });
  let from = null;
  canvas.addEventListener("pointerdown", (event) => { from = event; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointermove", (event) => {
    if (!from) return;
    state.yaw += (event.clientX - from.clientX) / 140;
    state.pitch = Math.min(1.5, Math.max(-1.5, state.pitch + (event.clientY - from.clientY) / 140));
    from = event;
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { from = null; });
  readColours();
  state.time = 0.6 * scene.motions[0].t.at(-1); // a time at which measured and predicted motion differ visibly
  window.addEventListener("resize", draw);
  for (const media of ["(prefers-color-scheme: dark)", "print"]) {
    matchMedia(media).addEventListener("change", () => { readColours(); draw(); });
  }
  draw();
  return { light(joints) { state.lit = joints; draw(); } };
})();
