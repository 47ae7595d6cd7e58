/* A mesh that turns under the mouse, a finger or the arrow keys: Plotly's mesh3d, in its own colours or in grey. */
(function (bench) {
  "use strict";

  const {element, soft, choice, later} = bench.dom;
  const START = {eye: {x: 1, y: -1.3, z: 0.7}, center: {x: 0, y: 0, z: 0}, up: {x: 0, y: 0, z: 1}};
  const KEYS = {ArrowLeft: [-0.12, 0, 1], ArrowRight: [0.12, 0, 1], ArrowUp: [0, 0.12, 1], ArrowDown: [0, -0.12, 1]};
  Object.assign(KEYS, {"+": [0, 0, 0.87], "=": [0, 0, 0.87], "-": [0, 0, 1.15]}); // radians, and a factor of the distance
  const MESH = {type: "mesh3d", hoverinfo: "skip", lightposition: {x: 4e4, y: -8e4, z: 1e5}};
  const LIGHTING = {ambient: 0.5, diffuse: 0.6, specular: 0.1, roughness: 0.9, fresnel: 0.05};
  Object.assign(LIGHTING, {facenormalsepsilon: 0, vertexnormalsepsilon: 0}); // small triangles would be black
  const drawn = new Set();

  /* A viewer of the mesh of a run; viewers that share a list turn together. */
  function mesh(index, together = []) {
    const loaded = Promise.all([bench.runs.mesh(index), bench.store.plotly()]);
    const show = ([data, plotly]) => (data.none ? soft(data.none) : viewer(plotly, data, bench.runs.title(index), together));
    return element("div.mesh", null, later(loaded, show));
  }

  function viewer(plotly, data, title, together) {
    const label = `Mesh of ${title}. Arrow keys turn it, plus and minus change the distance, Home turns it back.`;
    const plot = element("div.plot", {tabindex: 0, role: "img", "aria-label": label, keydown, wheel});
    const move = (...step) => turn(turned(plot.layout.scene.camera, step));
    const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

    /* Moves the cameras of all but the viewer that has been moved, which tell it in turn. */
    function turn(camera, moved) {
      for (const each of together)
        if (each !== moved && !same(each.layout.scene.camera, camera)) plotly.relayout(each, {"scene.camera": camera});
    }

    function keydown(event) {
      if (event.key !== "Home" && !Object.hasOwn(KEYS, event.key)) return;
      event.preventDefault();
      event.key === "Home" ? turn(START) : move(...KEYS[event.key]);
    }

    function wheel(event) {
      event.preventDefault();
      move(0, 0, Math.exp(event.deltaY / 500));
    }

    for (const old of drawn) if (!old.isConnected && drawn.delete(old)) plotly.purge(old); // a browser draws few at a time
    const {x, y, z, i, j, k, vertexcolor} = data;
    const paint = (look) => {
      const colours = look === "own" && vertexcolor ? {vertexcolor} : {color: "#c9ced6"};
      const trace = {...MESH, ...colours, lighting: LIGHTING, x, y, z, i, j, k};
      plotly.react(plot, [trace], plot.layout || layout(), {displayModeBar: false, responsive: true, scrollZoom: false});
    };
    requestAnimationFrame(() => {
      paint("own");
      drawn.add(plot);
      together.push(plot);
      for (const name of ["plotly_relayouting", "plotly_relayout"])
        plot.on(name, (changed) => changed["scene.camera"] && turn(changed["scene.camera"], plot));
    });
    const size = ([vertices, faces]) => `${vertices.toLocaleString("en")} vertices, ${faces.toLocaleString("en")} triangles`;
    const whole = data.shown[0] < data.whole[0] ? ` (of ${size(data.whole)} in mesh.ply)` : "";
    return [
      plot,
      vertexcolor && choice("How the mesh is drawn", {own: "Colours", grey: "Grey"}, "own", paint),
      element("p.soft", null, `${size(data.shown)}${whole}. Drag to turn, scroll to zoom.`),
    ];
  }

  function layout() {
    const axis = {visible: false, showspikes: false};
    const scene = {xaxis: axis, yaxis: axis, zaxis: axis, aspectmode: "data", camera: START, dragmode: "turntable"};
    return {scene, margin: {l: 0, r: 0, t: 0, b: 0}, paper_bgcolor: "rgba(0,0,0,0)"};
  }

  /* The camera moved around the vertical and up by angles, and its distance by a factor. */
  function turned({eye: {x, y, z}, center, up}, [right, higher, factor]) {
    const distance = Math.hypot(x, y, z);
    const azimuth = Math.atan2(y, x) + right;
    const elevation = Math.max(-1.5, Math.min(1.5, Math.asin(z / distance) + higher));
    const [flat, length] = [Math.cos(elevation), Math.max(0.4, Math.min(5, distance * factor))];
    const eye = {x: length * flat * Math.cos(azimuth), y: length * flat * Math.sin(azimuth), z: length * Math.sin(elevation)};
    return {eye, center, up};
  }

  bench.mesh = mesh;
})((window.implicitBench = window.implicitBench || {}));
