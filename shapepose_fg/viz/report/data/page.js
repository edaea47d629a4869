"use strict";
// What the reader does: play, go to a frame, turn the view, choose what is drawn.

(() => {
  const find = (id) => document.getElementById(id);
  const recording = new Recording(JSON.parse(find("scene-data").textContent));
  const eye = new Eye(recording.view, recording.cameras);
  const painter = new Painter(find("canvas"), recording, eye);
  const slider = find("frame"), clock = find("clock"), play = find("play"), strip = find("strip");
  const layers = ["bodies", "bones", "sigma", "trails", "cameras", "before"];
  const show = {};
  let at = 0, playing = false, clockStart = 0, timeStart = 0, waiting = false;

  function draw() {
    waiting = false;
    painter.draw(at, show);
    drawStrip();
  }
  function later() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(draw);
  }
  function go(index) {
    at = Math.min(recording.length - 1, Math.max(0, Math.round(index)));
    slider.value = at;
    const words = `frame ${recording.frames[at]} · ${recording.times[at].toFixed(2)} s`;
    clock.textContent = words;
    slider.setAttribute("aria-valuetext", words);
    later();
  }

  // Playing: in the recording's own time, whatever the screen's rate is.
  const last = recording.times[recording.length - 1];
  function setPlaying(on) {
    playing = on && recording.length > 1;
    play.textContent = playing ? "Pause" : "Play";
    play.setAttribute("aria-label", play.textContent);
    if (!playing) return;
    if (at === recording.length - 1) go(0);
    start();
    requestAnimationFrame(tick);
  }
  function start() {
    clockStart = performance.now();
    timeStart = recording.times[at];
  }
  function tick(now) {
    if (!playing) return;
    const time = timeStart + Math.max(0, now - clockStart) / 1000 * Number(find("speed").value);
    let next = at;
    while (next + 1 < recording.length && recording.times[next + 1] <= time) next++;
    if (next !== at) go(next);
    if (time > last) setPlaying(false);
    else requestAnimationFrame(tick);
  }
  play.addEventListener("click", () => setPlaying(!playing));
  find("speed").addEventListener("change", start);
  slider.addEventListener("input", () => { go(Number(slider.value)); start(); });

  // What is drawn.
  for (const name of layers) {
    const box = find(`show-${name}`);
    show[name] = box ? box.checked : false;
    if (box) box.addEventListener("change", () => { show[name] = box.checked; key(); later(); });
  }
  /** What the signs in the scene mean. */
  function key() {
    const grid = painter.step ? `lines every ${painter.step === 0.5 ? "half metre" : painter.step === 1 ? "metre" : `${painter.step} metres`}` : "";
    const said = [grid];
    if (show.bones) said.push("ring: no camera saw the joint in this frame");
    if (show.sigma) said.push("circle: holds the joint with 95 % probability");
    find("key").textContent = said.filter(Boolean).join(" · ");
  }
  const through = find("through");
  if (through) {
    through.addEventListener("change", () => {
      eye.through = through.value === "" ? null : Number(through.value);
      later();
    });
  }
  function free() { if (through && eye.through === null) through.value = ""; }
  find("reset").addEventListener("click", () => { eye.reset(); free(); later(); });

  // Turning, moving and zooming with mouse, fingers and keys.
  const canvas = painter.canvas, pointers = new Map();
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY, event.button === 2 || event.shiftKey]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before[0], dy = event.clientY - before[1];
    if (pointers.size === 2) {
      const other = [...pointers.entries()].find(([id]) => id !== event.pointerId)[1];
      const was = Math.hypot(before[0] - other[0], before[1] - other[1]);
      const is = Math.hypot(event.clientX - other[0], event.clientY - other[1]);
      if (was > 0) eye.scale(is / was);
      eye.move(dx / 2, dy / 2);
    } else if (before[2]) eye.move(dx, dy);
    else eye.turn(0.008 * dx, 0.008 * dy);
    before[0] = event.clientX;
    before[1] = event.clientY;
    free();
    later();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    // A page with a tall scene must still scroll: the wheel zooms once the scene was clicked.
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    eye.scale(Math.exp(-0.0015 * event.deltaY));
    free();
    later();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, 0.08], ArrowDown: [0, -0.08] };
    if (turns[event.key]) eye.turn(...turns[event.key]);
    else if (event.key === "+" || event.key === "=") eye.scale(1.15);
    else if (event.key === "-") eye.scale(1 / 1.15);
    else if (event.key === " ") setPlaying(!playing);
    else return;
    event.preventDefault();
    free();
    later();
  });

  // Who is there when: a row a person, filled as high as joints are seen.
  const rowHeight = Math.max(5, Math.min(22, Math.floor(220 / recording.people.length)));
  let presence = null;
  function summed(columns) {
    const there = recording.people.map(() => new Float32Array(columns).fill(-1));
    const sum = recording.people.map(() => new Float32Array(columns)), count = recording.people.map(() => new Uint16Array(columns));
    for (let f = 0; f < recording.length; f++) {
      const from = Math.floor(f * columns / recording.length);
      const to = Math.max(from + 1, Math.floor((f + 1) * columns / recording.length));
      for (let row = recording.starts[f]; row < recording.starts[f + 1]; row++) {
        const who = recording.who[row], share = recording.seenShare(row);
        for (let column = from; column < to; column++) { sum[who][column] += share; count[who][column]++; }
      }
    }
    there.forEach((shares, who) => shares.forEach((_, column) => {
      if (count[who][column]) shares[column] = sum[who][column] / count[who][column];
    }));
    return there;
  }
  function drawStrip() {
    const box = strip.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
    const ctx = strip.getContext("2d"), columns = Math.max(1, Math.floor(box.width));
    if (!presence || presence[0]?.length !== columns) {
      strip.width = Math.round(box.width * ratio);
      strip.height = Math.round(box.height * ratio);
      presence = summed(columns);
    }
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, box.width, box.height);
    presence.forEach((shares, who) => {
      const top = who * rowHeight + 1, tall = rowHeight - 2;
      shares.forEach((share, column) => {
        if (share < 0) return;
        ctx.fillStyle = recording.people[who].colour;
        ctx.globalAlpha = 0.25;
        ctx.fillRect(column, top, 1.02, tall);
        ctx.globalAlpha = 1;
        ctx.fillRect(column, top + tall * (1 - share), 1.02, tall * share);
      });
    });
    const x = (at + 0.5) * box.width / recording.length;
    ctx.fillStyle = painter.theme.ink;
    ctx.fillRect(x - 0.75, 0, 1.5, box.height);
  }
  function goTo(event) {
    const box = strip.getBoundingClientRect();
    go((event.clientX - box.left) / box.width * recording.length - 0.5);
    start();
  }
  strip.style.height = `${rowHeight * recording.people.length}px`;
  strip.addEventListener("pointerdown", (event) => { strip.setPointerCapture(event.pointerId); goTo(event); });
  strip.addEventListener("pointermove", (event) => { if (event.buttons & 1) goTo(event); });

  function resize() { painter.resize(); presence = null; later(); }
  new ResizeObserver(resize).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { painter.readTheme(); later(); });

  // The frame in the address (#frame=120), or the first with most people.
  function fromAddress() {
    const told = /frame=(\d+)/.exec(location.hash);
    const index = told ? recording.frames.findIndex((frame) => frame >= Number(told[1])) : -1;
    if (index >= 0) { go(index); return true; }
    return false;
  }
  addEventListener("hashchange", fromAddress);
  resize();
  if (!fromAddress()) {
    let most = 0;
    for (let f = 1; f < recording.length; f++) {
      if (recording.starts[f + 1] - recording.starts[f] > recording.starts[most + 1] - recording.starts[most]) most = f;
    }
    go(most);
  }
  draw();
  key();
})();
