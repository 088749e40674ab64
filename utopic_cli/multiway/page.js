(() => {
  "use strict";
  const canvas = document.getElementById("canvas");
  if (!canvas) return;
  const groups = JSON.parse(document.getElementById("model").textContent).map(group => ({
    colours: group.colours, scan: group.scan,
    points: new Int16Array(Uint8Array.from(atob(group.points), c => c.charCodeAt(0)).buffer),
  }));
  const start = () => ({yaw: .6, pitch: .35, zoom: 1});
  let shown = 0, camera = start(), asked = false;
  document.getElementById("no_view").hidden = true;

  // Points are far more than pixels deserve lines of code: a picture, a depth for each pixel, no library.
  function draw() {
    asked = false;
    const scale = Math.min(devicePixelRatio || 1, 2);
    const width = canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
    const height = canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
    const context = canvas.getContext("2d"), image = context.createImageData(width, height);
    const depth = new Float32Array(width * height).fill(-Infinity), group = groups[shown];
    const [cy, sy, cp, sp] = [Math.cos(camera.yaw), Math.sin(camera.yaw), Math.cos(camera.pitch), Math.sin(camera.pitch)];
    const unit = .48 * Math.min(width, height) * camera.zoom / 32767, few = group.points.length < 60000, dot = Math.max(2, Math.round((few ? 2 : 1.4) * scale));
    for (let i = 0, n = group.points.length / 3; i < n; i++) {
      const x = group.points[3*i], y = group.points[3*i + 1], z = group.points[3*i + 2];
      const right = cy*x - sy*y, back = sy*x + cy*y, near = sp*z - cp*back;  // z is up
      const u = Math.round(width / 2 + unit * right), v = Math.round(height / 2 - unit * (cp*z + sp*back));
      const [r, g, b] = group.colours[group.scan[i]], shade = .78 + .22 * Math.max(-1, Math.min(1, near / 32767));
      for (let dy = 0; dy < dot; dy++) for (let dx = 0; dx < dot; dx++) {
        const px = u + dx, py = v + dy, at = py * width + px;
        if (px < 0 || py < 0 || px >= width || py >= height || depth[at] > near) continue;
        depth[at] = near;
        image.data.set([r * shade, g * shade, b * shade, 255], 4 * at);
      }
    }
    context.putImageData(image, 0, 0);
  }
  function redraw() {
    if (!asked) { asked = true; requestAnimationFrame(draw); }
  }
  function turn(dx, dy) {
    camera.yaw += dx;
    camera.pitch = Math.max(-1.57, Math.min(1.57, camera.pitch + dy));
    redraw();
  }
  function zoom(by) {
    camera.zoom = Math.max(.3, Math.min(30, camera.zoom * by));
    redraw();
  }

  const fingers = new Map();
  const gap = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, {x: event.clientX, y: event.clientY});
  });
  canvas.addEventListener("pointermove", event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const apart = fingers.size === 2 ? gap() : 0, now = {x: event.clientX, y: event.clientY};
    fingers.set(event.pointerId, now);
    if (fingers.size === 1) turn((now.x - before.x) / 150, (now.y - before.y) / 150);
    else if (apart > 0) zoom(gap() / apart);
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500));
  }, {passive: false});
  canvas.addEventListener("keydown", event => {
    const act = {
      ArrowLeft: () => turn(-.1, 0), ArrowRight: () => turn(.1, 0), ArrowUp: () => turn(0, -.1), ArrowDown: () => turn(0, .1),
      "+": () => zoom(1.2), "-": () => zoom(1 / 1.2), 0: () => { camera = start(); redraw(); },
    }[event.key];
    if (act && !event.ctrlKey && !event.metaKey) { event.preventDefault(); act(); }
  });
  const buttons = [...document.querySelectorAll("button[data-group]")];
  for (const button of buttons) button.addEventListener("click", () => {
    shown = Number(button.dataset.group);
    for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  // Expand runs of points of one scan to a number for each point.
  for (const group of groups) group.scan = group.scan.flatMap((count, i) => Array(count).fill(i));
  redraw();
})();
