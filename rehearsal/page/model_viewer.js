// Shows the parts of a binary glTF: drag turns, the wheel zooms. The vertices are in the patient (LPS, mm).
"use strict";
(() => {
  const GAMMA = 2.2, TRANSLUCENT = 0.45, RADIANS_PER_PIXEL = 0.008;
  const VERTEX = `#version 300 es
    uniform mat4 projection; uniform vec3 shift;
    in vec3 position, normal; in vec3 colour;
    out vec3 n, c;
    void main() { n = normal; c = colour; gl_Position = projection * vec4(position + shift, 1.0); }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    uniform vec3 eye, light; uniform float opacity;
    in vec3 n, c;
    out vec4 colour;
    void main() {
      vec3 m = normalize(n) * (gl_FrontFacing ? 1.0 : -1.0);
      float bright = 0.45 + 0.35 * max(dot(m, eye), 0.0) + 0.25 * max(dot(m, light), 0.0);
      colour = vec4(pow(c, vec3(1.0 / ${GAMMA})) * min(bright, 1.05) * opacity, opacity);
    }`;

  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const scaled = (a, s) => a.map((v) => v * s);
  const unit = (a) => scaled(a, 1 / Math.hypot(...a));

  // The parts of a binary glTF: arrays of positions, normals, colours and indices by name.
  function partsOf(bytes) {
    const data = new DataView(bytes.buffer), length = data.getUint32(12, true);
    const tree = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + length)));
    const start = 20 + length + 8;
    const array = (number, Type, width) => {
      const accessor = tree.accessors[number], view = tree.bufferViews[accessor.bufferView];
      const from = start + (view.byteOffset || 0) + (accessor.byteOffset || 0);
      return new Type(bytes.buffer.slice(from, from + accessor.count * width * Type.BYTES_PER_ELEMENT));
    };
    return tree.meshes.map((mesh) => {
      const { attributes, indices } = mesh.primitives[0];
      return {
        name: mesh.name,
        position: array(attributes.POSITION, Float32Array, 3),
        normal: array(attributes.NORMAL, Float32Array, 3),
        colour: array(attributes.COLOR_0, Uint8Array, 4),
        index: array(indices, Uint32Array, 1),
      };
    });
  }

  function boundsOf(parts) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const { position } of parts)
      position.forEach((v, n) => {
        low[n % 3] = Math.min(low[n % 3], v);
        high[n % 3] = Math.max(high[n % 3], v);
      });
    return [low, high];
  }

  const canvas = document.querySelector("#viewer canvas");
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) {
    document.body.classList.add("no-webgl");
    return;
  }

  function compiled(kind, source) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, FRAGMENT));
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const at = { projection: uniform("projection"), shift: uniform("shift"), eye: uniform("eye"),
    light: uniform("light"), opacity: uniform("opacity") };

  function uploaded(part) {
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    const fill = (name, data, width, kind, normalized) => {
      const place = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, kind, normalized, width, 0);
    };
    fill("position", part.position, 12, gl.FLOAT, false);
    fill("normal", part.normal, 12, gl.FLOAT, false);
    fill("colour", part.colour, 4, gl.UNSIGNED_BYTE, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, part.index, gl.STATIC_DRAW);
    return vertices;
  }

  const text = (id) => document.getElementById(id).textContent;
  const view = JSON.parse(text("view"));
  const parts = partsOf(Uint8Array.from(atob(text("model")), (letter) => letter.charCodeAt(0)));
  for (const part of parts) {
    part.vertices = uploaded(part);
    part.shown = true;
    part.lifted = view.lifted.includes(part.name);
    part.seeThrough = ["kidney", "specimen"].includes(part.name);
  }
  let turn = Math.atan2(view.eye[0], -view.eye[1]);
  let tilt = Math.asin(Math.max(-1, Math.min(1, unit(view.eye)[2])));
  let zoom = 1, lift = view.lift_mm, isTranslucent = view.translucent;
  const lifts = (part, mm) => (part.lifted ? scaled(view.lift, mm) : [0, 0, 0]);

  // The axes of the view in LPS: right, up, and towards the eye; the head is up.
  function axes() {
    const eye = [Math.sin(turn) * Math.cos(tilt), -Math.cos(turn) * Math.cos(tilt), Math.sin(tilt)];
    const right = [Math.cos(turn), Math.sin(turn), 0];
    return [right, cross(eye, right), eye];
  }

  // What is seen stays in the middle, also where the specimen is lifted.
  function frame() {
    const moved = parts.map((part) => ({ low: boundsOf([part]), by: lifts(part, lift) }));
    const low = [0, 1, 2].map((k) => Math.min(...moved.map((m) => m.low[0][k] + m.by[k])));
    const high = [0, 1, 2].map((k) => Math.max(...moved.map((m) => m.low[1][k] + m.by[k])));
    const middle = low.map((v, k) => (v + high[k]) / 2);
    return [middle, Math.hypot(...high.map((v, k) => v - low[k])) / 2];
  }
  let [middle, radius] = frame();

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.953, 0.961, 0.969, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const [right, up, eye] = axes(), high = zoom / (0.86 * radius), wide = high * canvas.height / canvas.width;
    const rows = [scaled(right, wide), scaled(up, high), scaled(eye, -1 / (4 * radius))];
    const matrix = [0, 1, 2].flatMap((k) => [...rows.map((row) => row[k]), 0]);
    gl.uniformMatrix4fv(at.projection, false, [...matrix, ...rows.map((row) => -dot(row, middle)), 1]);
    gl.uniform3fv(at.eye, eye);
    gl.uniform3fv(at.light, unit(right.map((v, k) => -0.5 * v + 0.7 * up[k] + 0.5 * eye[k])));
    const shown = parts.filter((part) => part.shown);
    const solid = shown.filter((part) => !(isTranslucent && part.seeThrough));
    solid.forEach((part) => drawPart(part, 1));
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    for (const side of [gl.FRONT, gl.BACK]) {
      gl.cullFace(side);
      shown.filter((part) => !solid.includes(part)).forEach((part) => drawPart(part, TRANSLUCENT));
    }
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.BLEND);
    placeLetters(right, up, eye);
  }

  function drawPart(part, opacity) {
    gl.uniform3fv(at.shift, lifts(part, lift));
    gl.uniform1f(at.opacity, opacity);
    gl.bindVertexArray(part.vertices);
    gl.drawElements(gl.TRIANGLES, part.index.length, gl.UNSIGNED_INT, 0);
  }

  const letters = Object.entries({ L: [1, 0, 0], R: [-1, 0, 0], P: [0, 1, 0], A: [0, -1, 0], S: [0, 0, 1],
    I: [0, 0, -1] }).map(([letter, axis]) => {
    const span = document.createElement("span");
    span.textContent = letter;
    document.getElementById("letters").append(span);
    return [span, axis];
  });

  // Of letters that would be over each other the nearest is shown.
  function placeLetters(right, up, eye) {
    const shown = [];
    for (const [span, axis] of letters.sort((a, b) => dot(b[1], eye) - dot(a[1], eye))) {
      const x = 52 + 34 * dot(axis, right), y = canvas.clientHeight - 50 - 34 * dot(axis, up);
      span.hidden = shown.some(([a, b]) => Math.hypot(a - x, b - y) < 16);
      shown.push([x, y]);
      span.style.left = `${x}px`;
      span.style.top = `${y}px`;
      span.style.color = dot(axis, eye) >= 0 ? "#16191d" : "#a9b1b9";
    }
  }

  let isDue = false;
  function drawSoon() {
    if (isDue) return;
    isDue = true;
    requestAnimationFrame(() => {
      isDue = false;
      draw();
    });
  }

  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    turn -= RADIANS_PER_PIXEL * event.movementX;
    tilt = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, tilt + RADIANS_PER_PIXEL * event.movementY));
    drawSoon();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom = Math.max(0.4, Math.min(8, zoom * Math.exp(-0.001 * event.deltaY)));
    drawSoon();
  }, { passive: false });
  window.addEventListener("resize", drawSoon);

  function control(label, input, colour) {
    const row = document.createElement("label"), swatch = document.createElement("i");
    row.append(input);
    if (colour) {
      swatch.style.background = colour;
      row.append(swatch);
    }
    row.append(` ${label} `);
    document.getElementById("controls").append(row);
  }
  function checkbox(isOn, change) {
    const input = Object.assign(document.createElement("input"), { type: "checkbox", checked: isOn });
    input.addEventListener("change", () => {
      change(input.checked);
      drawSoon();
    });
    return input;
  }
  for (const part of parts)
    control(part.name, checkbox(true, (isOn) => { part.shown = isOn; }), view.colours[part.name]);
  control("translucent", checkbox(isTranslucent, (isOn) => { isTranslucent = isOn; }));
  if (view.lifted.length) {
    const slider = Object.assign(document.createElement("input"), { type: "range", min: 0,
      max: 2 * view.lift_mm, value: lift });
    slider.addEventListener("input", () => {
      lift = Number(slider.value);
      [middle, radius] = frame();
      drawSoon();
    });
    control("specimen lifted", slider);
  }
  draw();
})();
