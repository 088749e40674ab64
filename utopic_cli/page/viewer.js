(() => {
  "use strict";
  const get = id => document.getElementById(id);

  // ---- what needs no 3D: the theme and the copy button ----------------------------------------------
  const root = document.documentElement, system = matchMedia("(prefers-color-scheme: dark)");
  const dark = () => root.dataset.theme ? root.dataset.theme === "dark" : system.matches;
  function themed() {
    get("theme").textContent = dark() ? "Light" : "Dark";
    get("theme").setAttribute("aria-label", `Switch to ${dark() ? "light" : "dark"} colours`);
    redraw();
  }
  get("theme").addEventListener("click", () => { root.dataset.theme = dark() ? "light" : "dark"; themed(); });
  system.addEventListener("change", themed);

  get("copy").addEventListener("click", async () => {
    const text = get("matrix").textContent;
    let done = true;
    try {
      await navigator.clipboard.writeText(text);
    } catch {  // pages opened from a file may not have the clipboard; a selection can be copied anyhow
      get("matrix").closest("details").open = true;
      getSelection().selectAllChildren(get("matrix"));
      done = document.execCommand("copy");
    }
    get("copied").textContent = done ? "copied, all digits" : "selected below: copy it from there";
  });
  get("theme").hidden = get("copy").hidden = false;

  // ---- quaternions (w, x, y, z) and vectors ---------------------------------------------------------
  const times = ([a, b, c, d], [w, x, y, z]) =>
    [a*w - b*x - c*y - d*z, a*x + b*w + c*z - d*y, a*y - b*z + c*w + d*x, a*z + b*y - c*x + d*w];
  const mix = (a, b, t) => a.map((value, i) => value + (b[i] - value) * t);
  function unit(q) {
    const length = Math.hypot(...q);
    return q.map(value => value / length);
  }
  function rows([w, x, y, z]) {
    return [[1 - 2*(y*y + z*z), 2*(x*y - w*z), 2*(x*z + w*y)],
            [2*(x*y + w*z), 1 - 2*(x*x + z*z), 2*(y*z - w*x)],
            [2*(x*z - w*y), 2*(y*z + w*x), 1 - 2*(x*x + y*y)]];
  }
  const turned = (q, p) => rows(q).map(row => row[0]*p[0] + row[1]*p[1] + row[2]*p[2]);
  const inverse = ([w, x, y, z]) => [w, -x, -y, -z];
  function slerp(a, b, t) {
    let dot = a.reduce((sum, value, i) => sum + value * b[i], 0);
    if (dot < 0) { b = b.map(value => -value); dot = -dot; }
    if (dot > .9999) return unit(mix(a, b, t));
    const angle = Math.acos(dot);
    return unit(a.map((value, i) => (Math.sin((1 - t) * angle) * value + Math.sin(t * angle) * b[i]) / Math.sin(angle)));
  }

  // ---- the scene ------------------------------------------------------------------------------------
  const scene = JSON.parse(get("scene").textContent), canvas = get("canvas");
  const HALF_ANGLE = Math.tan(16 * Math.PI / 180);  // of the narrower side of the picture
  const ROOM = 1.16;  // how much of the scene's radius that side shows at first
  const start = () => ({turn: scene.turn.slice(), offset: [0, 0, 0], zoom: 1});
  let camera = start(), view = 1, size = 1;
  let gl = null, drawing = null, asked = false;
  // What is shown now; switching views moves it to the new pose and frame.
  const now = {...scene.poses[1], ...scene.frames[1]};
  let from = null, since = 0;

  function bytes(text) {
    return Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  }
  const clouds = scene.clouds.map(cloud => ({...cloud, places: bytes(cloud.places), values: bytes(cloud.values)}));
  const colours = bytes(scene.map);

  const POINTS = [`#version 300 es
    in vec3 place;
    in vec3 value;  // overlap, uncertainty, residual; 255: unknown
    uniform mat4 toEye;
    uniform vec4 lens;  // scale of x and y, near, far
    uniform float size;
    uniform int shown;
    uniform vec3 plain;
    uniform sampler2D map;
    out vec3 colour;
    void main() {
      vec4 eye = toEye * vec4(place, 1.0);
      float away = -eye.z, near = lens.z, far = lens.w;
      gl_Position = vec4(eye.xy * lens.xy, (away * (far + near) - 2.0 * far * near) / (far - near), away);
      gl_PointSize = clamp(size / away, 1.0, 60.0);
      float level = shown < 0 ? 0.0 : value[shown];
      colour = shown < 0 ? plain : level > 254.5 ? vec3(0.5) : texture(map, vec2((level + 0.5) / 255.0, 0.5)).rgb;
    }`, `#version 300 es
    precision highp float;
    in vec3 colour;
    out vec4 pixel;
    void main() {
      vec2 place = gl_PointCoord - 0.5;
      if (dot(place, place) > 0.25) discard;
      pixel = vec4(colour, 1.0);
    }`];
  // Points have no light of their own: a pixel is darkened by how far its neighbours stand before it.
  const SHADE = [`#version 300 es
    in vec2 corner;
    void main() { gl_Position = vec4(corner, 0.0, 1.0); }`, `#version 300 es
    precision highp float;
    uniform sampler2D drawn;
    uniform highp sampler2D depth;
    uniform vec2 range;  // near, far
    uniform vec3 paper;
    uniform float pixelAngle;  // width of a pixel at distance 1
    uniform int reach;
    out vec4 pixel;
    float away(ivec2 place) {
      ivec2 last = textureSize(depth, 0) - 1;
      float z = texelFetch(depth, clamp(place, ivec2(0), last), 0).r;
      return z >= 1.0 ? -1.0 : range.x * range.y / (range.y - z * (range.y - range.x));
    }
    void main() {
      ivec2 here = ivec2(gl_FragCoord.xy);
      float own = away(here);
      if (own < 0.0) { pixel = vec4(paper, 1.0); return; }
      float sum = 0.0, step = own * pixelAngle * float(reach);
      for (int i = 0; i < 8; i++) {
        int j = i < 4 ? i : i + 1;
        float other = away(here + reach * ivec2(j % 3 - 1, j / 3 - 1));
        if (other > 0.0) sum += clamp((own - other) / step - 0.6, 0.0, 6.0);
      }
      pixel = vec4(texelFetch(drawn, here, 0).rgb * (0.35 + 0.65 * exp(-0.1 * sum)), 1.0);
    }`];

  function program(sources) {
    const made = gl.createProgram();
    [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, i) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, sources[i]);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    });
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(made));
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(made, i).name;
      at[name] = gl.getUniformLocation(made, name);
    }
    return {made, at};
  }
  function attribute(owner, name, data, kind, width) {
    const place = gl.getAttribLocation(owner.made, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, width, kind, false, 0, 0);
  }
  function texture(smooth) {
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, smooth);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    return made;
  }
  function prepare() {
    const points = program(POINTS), shade = program(SHADE);
    const arrays = clouds.map(cloud => {
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      attribute(points, "place", cloud.places, gl.SHORT, 3);
      attribute(points, "value", cloud.values, gl.UNSIGNED_BYTE, 3);
      return array;
    });
    const screen = gl.createVertexArray();
    gl.bindVertexArray(screen);
    attribute(shade, "corner", new Float32Array([-1, -1, 3, -1, -1, 3]), gl.FLOAT, 2);
    const map = texture(gl.NEAREST);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, colours.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, colours);
    drawing = {points, shade, arrays, screen, map, frame: gl.createFramebuffer(), colour: null, depth: null};
  }
  function fit() {  // the canvas and what is drawn on have the size of the place on the screen
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (drawing.colour && canvas.width === width && canvas.height === height) return ratio;
    canvas.width = width;
    canvas.height = height;
    gl.deleteTexture(drawing.colour);
    gl.deleteTexture(drawing.depth);
    drawing.colour = texture(gl.NEAREST);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    drawing.depth = texture(gl.NEAREST);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, drawing.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, drawing.colour, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, drawing.depth, 0);
    return ratio;
  }
  function css(name) {  // a colour of the page as three numbers
    const text = getComputedStyle(root).getPropertyValue(name).trim();
    const digits = text.length === 4 ? [...text.slice(1)].map(digit => digit + digit) : text.slice(1).match(/../g);
    return digits.map(pair => parseInt(pair, 16) / 255);
  }
  const middle = () => now.middle.map((value, i) => value + now.radius * camera.offset[i]);
  const distance = () => ROOM * now.radius / (HALF_ANGLE * camera.zoom);
  // How large the picture's half width and height are at distance 1.
  function halves() {
    const aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
    return [HALF_ANGLE * Math.max(aspect, 1), HALF_ANGLE * Math.max(1 / aspect, 1)];
  }

  function draw() {
    asked = false;
    if (!drawing || gl.isContextLost()) return;
    move();
    const ratio = fit(), away = distance(), [wide, high] = halves();
    // Before and behind what is in view lies at most the rest of the scene.
    const far = away + 6 * Math.max(now.radius, 1), near = Math.max(away / 200, Math.min(away - 6 * Math.max(now.radius, 1), away / 2));
    const {points, shade} = drawing;
    gl.bindFramebuffer(gl.FRAMEBUFFER, drawing.frame);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(points.made);
    gl.uniform4f(points.at.lens, 1 / wide, 1 / high, near, far);
    // Points keep their size in the scene: nearer is larger, and zooming in opens no holes.
    gl.uniform1f(points.at.size, size * pointSize * ratio * ROOM * now.radius / HALF_ANGLE);
    gl.uniform1i(points.at.shown, scene.views[view].values);
    gl.uniform1i(points.at.map, 0);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, drawing.map);
    ["source", "target"].forEach((side, i) => {
      if (!get("show_" + side).checked) return;
      gl.uniform3fv(points.at.plain, css("--" + side));
      gl.uniformMatrix4fv(points.at.toEye, false, toEye(i ? scene.target : now, clouds[i].step, away));
      gl.bindVertexArray(drawing.arrays[i]);
      gl.drawArrays(gl.POINTS, 0, clouds[i].count);
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(shade.made);
    [drawing.colour, drawing.depth].forEach((bound, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, bound);
    });
    gl.uniform1i(shade.at.drawn, 0);
    gl.uniform1i(shade.at.depth, 1);
    gl.uniform2f(shade.at.range, near, far);
    gl.uniform1f(shade.at.pixelAngle, 2 * high / canvas.height);
    gl.uniform1i(shade.at.reach, Math.max(1, Math.round(ratio)));
    gl.uniform3fv(shade.at.paper, css("--stage"));
    gl.bindVertexArray(drawing.screen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (from) redraw();
  }
  function toEye(pose, step, away) {  // column by column, from a cloud's 16-bit steps to the camera
    const model = rows(times(camera.turn, pose.turn)), centre = middle();
    const place = turned(camera.turn, pose.place.map((value, i) => value - centre[i]));
    place[2] -= away;
    return [0, 1, 2].flatMap(column => [...model.map(row => row[column] * step), 0]).concat(place, 1);
  }
  function redraw() {
    if (drawing && !asked) { asked = true; requestAnimationFrame(draw); }
  }

  // ---- switching views ------------------------------------------------------------------------------
  function move() {
    const number = scene.views[view].pose, pose = scene.poses[number], frame = scene.frames[number];
    const t = from ? Math.min((performance.now() - since) / 500, 1) : 1, eased = t * t * (3 - 2 * t);
    const start = from || now;
    now.turn = t < 1 ? slerp(start.turn, pose.turn, eased) : pose.turn;
    now.place = mix(start.place, pose.place, eased);
    now.middle = mix(start.middle, frame.middle, eased);
    now.radius = start.radius + (frame.radius - start.radius) * eased;
    if (t === 1) from = null;
  }
  function choose(number) {
    const moves = scene.views[number].pose !== scene.views[view].pose;
    view = number;
    for (const button of document.querySelectorAll("[data-view]"))
      button.setAttribute("aria-pressed", String(Number(button.dataset.view) === number));
    for (const note of document.querySelectorAll("[data-note]")) {
      note.hidden = Number(note.dataset.note) !== number;
      if (note.hidden) continue;
      for (const legend of document.querySelectorAll("[data-for]")) legend.hidden = legend.dataset.for !== note.dataset.legend;
    }
    if (moves && !matchMedia("(prefers-reduced-motion: reduce)").matches) { from = {...now}; since = performance.now(); }
    redraw();
  }
  // ---- turning, moving, zooming ---------------------------------------------------------------------
  function turn(dx, dy) {  // in CSS pixels
    const length = Math.hypot(dx, dy);
    if (!length) return;
    const angle = length / 150, sine = Math.sin(angle / 2) / length;
    camera.turn = unit(times([Math.cos(angle / 2), dy * sine, dx * sine, 0], camera.turn));
    redraw();
  }
  function shift(dx, dy) {
    const perPixel = 2 * halves()[1] * distance() / canvas.clientHeight / now.radius;
    const moved = turned(inverse(camera.turn), [-dx * perPixel, dy * perPixel, 0]);
    camera.offset = camera.offset.map((value, i) => value + moved[i]);
    redraw();
  }
  function zoom(factor) {
    camera.zoom = Math.min(Math.max(camera.zoom * factor, .2), 60);
    redraw();
  }
  function reset() { camera = start(); redraw(); }

  const fingers = new Map();
  function spread() {  // the middle of the fingers and how far apart they are
    const [a, b] = [...fingers.values()];
    return b ? {x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y)} : {...a, apart: 0};
  }
  function listen() {
    canvas.addEventListener("pointerdown", event => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, {x: event.clientX, y: event.clientY});
    });
    canvas.addEventListener("pointermove", event => {
      if (!fingers.has(event.pointerId)) return;
      const before = spread();
      fingers.set(event.pointerId, {x: event.clientX, y: event.clientY});
      const after = spread(), dx = after.x - before.x, dy = after.y - before.y;
      if (fingers.size > 1 || event.buttons & 6 || event.shiftKey) shift(dx, dy);
      else turn(dx, dy);
      if (before.apart && after.apart) zoom(after.apart / before.apart);
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"])
      canvas.addEventListener(name, event => fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("dblclick", reset);
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      const pixels = event.deltaY * [1, 30, 400][event.deltaMode];
      zoom(Math.exp(-Math.max(-300, Math.min(300, pixels)) * (event.ctrlKey ? .01 : .0015)));
    }, {passive: false});
    const arrows = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};
    canvas.addEventListener("keydown", event => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const arrow = arrows[event.key];
      if (arrow) (event.shiftKey ? shift : turn)(20 * arrow[0], 20 * arrow[1]);
      else if (event.key === "+" || event.key === "=") zoom(1.2);
      else if (event.key === "-") zoom(1 / 1.2);
      else if (event.key === "0") reset();
      else return;
      event.preventDefault();
    });
    get("reset").addEventListener("click", reset);
    get("size").addEventListener("input", () => { size = 2 ** Number(get("size").value); redraw(); });
    for (const side of ["source", "target"]) get("show_" + side).addEventListener("change", redraw);
    for (const button of document.querySelectorAll("[data-view]"))
      button.addEventListener("click", () => choose(Number(button.dataset.view)));
    canvas.addEventListener("webglcontextlost", event => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { prepare(); redraw(); });
    new ResizeObserver(redraw).observe(canvas);
  }
  // Few points are drawn larger, so that a surface is seen; in CSS pixels at the first zoom.
  const pointSize = Math.min(Math.max(600 / Math.sqrt(Math.max(clouds[0].count, clouds[1].count)), 1.6), 9);

  try {
    // Kept after drawing, so that the picture can be printed and saved.
    gl = canvas.getContext("webgl2", {antialias: false, alpha: false, preserveDrawingBuffer: true});
    if (gl) prepare();
  } catch (error) {
    gl = drawing = null;
    console.warn("3D view:", error.message);
  }
  if (drawing) {
    get("no_view").hidden = true;
    listen();
  } else {
    get("no_view").textContent = "This browser has no WebGL 2, which the 3D view needs. Everything else is here without it; " +
      "the scans themselves open in any viewer of point clouds.";
    for (const control of document.querySelectorAll(".view button, .view input")) control.disabled = true;
  }
  themed();
})();
