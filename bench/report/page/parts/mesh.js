/* A mesh that turns under the mouse, a finger or the arrow keys: plain WebGL, drawn only when something changes. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  const START = {azimuth: 0.7, elevation: 0.35, zoom: 1};
  const VERTEX = `
    attribute vec3 position; attribute vec3 normal; attribute vec3 colour;
    uniform mat4 projection; uniform mat4 camera;
    varying vec3 facing; varying vec3 outward; varying vec3 own;
    void main() {
      facing = (camera * vec4(normal, 0.0)).xyz; outward = normal; own = colour;
      gl_Position = projection * camera * vec4(position, 1.0);
    }`;
  const FRAGMENT = `
    precision mediump float;
    varying vec3 facing; varying vec3 outward; varying vec3 own;
    uniform float look;
    void main() {
      vec3 n = normalize(facing);
      if (!gl_FrontFacing) n = -n;
      float key = max(dot(n, normalize(vec3(0.5, 0.7, 0.8))), 0.0), fill = max(dot(n, normalize(vec3(-0.8, 0.1, 0.5))), 0.0);
      float rim = pow(1.0 - abs(n.z), 3.0);
      vec3 base = look > 1.5 ? own : look > 0.5 ? 0.5 + 0.5 * normalize(outward) : vec3(0.80, 0.82, 0.85);
      vec3 shaded = base * (0.30 + 0.62 * key + 0.22 * fill) + 0.10 * rim;
      gl_FragColor = vec4(look > 0.5 && look < 1.5 ? base : shaded, 1.0);
    }`;

  /* A view that several viewers share, so that they turn together. */
  function view() {
    return {...START, draws: []};
  }

  /* A viewer of the mesh of a run; the data are loaded first. */
  function viewer(place, shared = view()) {
    const home = element("div.mesh", null, element("p.soft", null, "Loading the mesh …"));
    bench.store.load("mesh", bench.runs.key(place)).then(
      (data) => {
        if (data.none) fill(home, element("p.soft", null, data.none));
        else show(home, unpacked(data), shared, bench.runs.title(place));
      },
      (error) => fill(home, element("p.soft", null, error.message)),
    );
    return home;
  }

  function bytes(text) {
    const raw = atob(text);
    return Uint8Array.from(raw, (character) => character.charCodeAt(0));
  }

  /* Positions, normals as means over the faces around a vertex, colours and triangles. */
  function unpacked(data) {
    const levels = new Uint16Array(bytes(data.vertices).buffer);
    const faces = new Uint16Array(bytes(data.faces).buffer);
    const positions = Float32Array.from(
      levels,
      (level, n) => data.low[n % 3] + (level / 65535) * (data.high[n % 3] - data.low[n % 3]),
    );
    const normals = new Float32Array(positions.length);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const [ux, uy, uz] = [0, 1, 2].map((axis) => positions[b + axis] - positions[a + axis]);
      const [vx, vy, vz] = [0, 1, 2].map((axis) => positions[c + axis] - positions[a + axis]);
      const cross = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
      for (const at of [a, b, c]) for (const axis of [0, 1, 2]) normals[at + axis] += cross[axis];
    }
    const colours = data.colours ? Float32Array.from(bytes(data.colours), (value) => value / 255) : null;
    return {
      positions,
      normals,
      colours,
      faces,
      shown: data.shown,
      whole: data.whole,
      middle: data.low.map((low, n) => (low + data.high[n]) / 2),
      radius: Math.hypot(...data.low.map((low, n) => data.high[n] - low)) / 2 || 1,
    };
  }

  function show(home, mesh, shared, title) {
    const canvas = element("canvas", {
      tabindex: 0,
      role: "img",
      "aria-label": `Mesh of ${title}. Arrow keys turn it, plus and minus change the distance, Home turns it back.`,
    });
    const gl = canvas.getContext("webgl", {antialias: true, alpha: true});
    if (!gl) {
      fill(home, element("p.soft", null, "This browser has no WebGL: open mesh.ply in another program."));
      return;
    }
    const state = {look: mesh.colours ? 2 : 0};
    const paint = painter(gl, mesh);
    const draw = () => requestAnimationFrame(() => canvas.isConnected && paint(canvas, shared, state.look));
    shared.draws.push(draw);
    const all = () => shared.draws.forEach((each) => each());
    const looks = [["Shaded", 0], ["Normals", 1], ...(mesh.colours ? [["Colours", 2]] : [])];
    const buttons = looks.map(([name, look]) =>
      element(
        "button",
        {
          type: "button",
          "aria-pressed": String(look === state.look),
          click: (event) => {
            state.look = look;
            for (const button of buttons) button.setAttribute("aria-pressed", String(button === event.currentTarget));
            draw();
          },
        },
        name,
      ),
    );
    const [vertices, faces] = mesh.shown.map((n) => n.toLocaleString("en"));
    const thinned =
      mesh.shown[0] < mesh.whole[0]
        ? `, of ${mesh.whole[0].toLocaleString("en")} and ${mesh.whole[1].toLocaleString("en")} in mesh.ply`
        : "";
    fill(
      home,
      canvas,
      element(
        "div.mesh-tools",
        null,
        element("div.switch", {role: "group", "aria-label": "How the mesh is drawn"}, buttons),
        element("span.soft", null, `${vertices} vertices, ${faces} triangles${thinned}. Drag to turn, scroll to zoom.`),
      ),
    );
    listen(canvas, shared, all);
    new ResizeObserver(draw).observe(canvas);
    draw();
  }

  function painter(gl, mesh) {
    const program = gl.createProgram();
    for (const [kind, source] of [
      [gl.VERTEX_SHADER, VERTEX],
      [gl.FRAGMENT_SHADER, FRAGMENT],
    ]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    const attributes = {
      position: mesh.positions,
      normal: mesh.normals,
      colour: mesh.colours || new Float32Array(mesh.positions.length),
    };
    for (const [name, values] of Object.entries(attributes)) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      const at = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.faces, gl.STATIC_DRAW);
    gl.enable(gl.DEPTH_TEST);
    const at = (name) => gl.getUniformLocation(program, name);
    const [projection, camera, look] = [at("projection"), at("camera"), at("look")];
    return (canvas, shared, chosen) => {
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map(Math.round);
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const distance = (3.2 * mesh.radius) / shared.zoom;
      gl.uniformMatrix4fv(
        projection,
        false,
        perspective(width / height, Math.max(0.01, distance - 2 * mesh.radius), distance + 2 * mesh.radius),
      );
      gl.uniformMatrix4fv(camera, false, orbit(shared, mesh.middle, distance));
      gl.uniform1f(look, chosen);
      gl.drawElements(gl.TRIANGLES, mesh.faces.length, gl.UNSIGNED_SHORT, 0);
    };
  }

  /* A perspective that shows the whole shape in the narrower direction; matrices are column by column. */
  function perspective(aspect, near, far) {
    const focal = 2.7 * Math.min(1, aspect);
    return [
      focal / aspect,
      0,
      0,
      0,
      0,
      focal,
      0,
      0,
      0,
      0,
      (far + near) / (near - far),
      -1,
      0,
      0,
      (2 * far * near) / (near - far),
      0,
    ];
  }

  /* The world as a camera sees it that looks at the middle; y is up. */
  function orbit({azimuth, elevation}, middle, distance) {
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    const rows = [
      [ca, 0, -sa],
      [-sa * se, ce, -ca * se],
      [sa * ce, se, ca * ce],
    ];
    const shift = rows.map((row) => -row.reduce((sum, value, n) => sum + value * middle[n], 0));
    return [
      ...[0, 1, 2].flatMap((n) => [rows[0][n], rows[1][n], rows[2][n], 0]),
      shift[0],
      shift[1],
      shift[2] - distance,
      1,
    ];
  }

  function listen(canvas, shared, draw) {
    const turn = (right, up) => {
      shared.azimuth -= right;
      shared.elevation = Math.min(1.55, Math.max(-1.55, shared.elevation + up));
      draw();
    };
    const zoom = (factor) => {
      shared.zoom = Math.min(6, Math.max(0.5, shared.zoom * factor));
      draw();
    };
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener(
      "pointermove",
      (event) => event.buttons && turn(event.movementX / 120, event.movementY / 120),
    );
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        zoom(Math.exp(-event.deltaY / 500));
      },
      {passive: false},
    );
    const keys = {
      ArrowLeft: () => turn(-0.12, 0),
      ArrowRight: () => turn(0.12, 0),
      ArrowUp: () => turn(0, 0.12),
      ArrowDown: () => turn(0, -0.12),
      "+": () => zoom(1.15),
      "=": () => zoom(1.15),
      "-": () => zoom(1 / 1.15),
      Home: () => draw(Object.assign(shared, START)),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  bench.mesh = {viewer, view};
})((window.implicitBench = window.implicitBench || {}));
