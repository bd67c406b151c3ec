// The 3-D view: layers of a demo -> traces of plotly. See viewer.py for what a view holds.
document.addEventListener("plotting", () => {
  const { views, colours, colour: first } = content("views"), $ = id => document.getElementById(id), stage = $("stage");
  const DISTANCE = 1.2; // of the eye from the middle of the view, which the container spans with about 1.1
  const switched = {}; // layer name -> shown, once somebody has clicked it
  let view = null;

  // ---- arrays and geometry
  const numbers = (text, Kind) => new Kind(bytes(text).buffer);
  const moved = (T, x, y, z) => T ? [0, 4, 8].map(r => T[r] * x + T[r + 1] * y + T[r + 2] * z + T[r + 3]) : [x, y, z];
  const mesh = (vertices, faces) => ({ x: new Float32Array(vertices), y: new Float32Array(vertices), z: new Float32Array(vertices),
    i: new Uint32Array(faces), j: new Uint32Array(faces), k: new Uint32Array(faces) });
  const put = (m, at, p) => { m.x[at] = p[0]; m.y[at] = p[1]; m.z[at] = p[2]; };
  const face = (m, at, i, j, k) => { m.i[at] = i; m.j[at] = j; m.k[at] = k; };
  function hexagons(cloud, T) {
    const steps = numbers(cloud.points, Uint16Array), normals = numbers(cloud.normals, Int8Array), n = steps.length / 3, m = mesh(6 * n, 4 * n);
    const turn = T && [T[0], T[1], T[2], 0, T[4], T[5], T[6], 0, T[8], T[9], T[10], 0];
    for (let p = 0; p < n; p++) {
      const [x, y, z] = moved(T, ...[0, 1, 2].map(a => cloud.low[a] + steps[3 * p + a] * cloud.step[a]));
      const N = moved(turn, normals[3 * p] / 127, normals[3 * p + 1] / 127, normals[3 * p + 2] / 127);
      const side = Math.abs(N[2]) < 0.9 ? [-N[1], N[0], 0] : [0, -N[2], N[1]], length = Math.hypot(...side) || 1;
      const u = side.map(s => s / length * cloud.radius), v = [N[1] * u[2] - N[2] * u[1], N[2] * u[0] - N[0] * u[2], N[0] * u[1] - N[1] * u[0]];
      for (let c = 0; c < 6; c++) {
        const a = Math.cos(c * Math.PI / 3), b = Math.sin(c * Math.PI / 3);
        put(m, 6 * p + c, [x + a * u[0] + b * v[0], y + a * u[1] + b * v[1], z + a * u[2] + b * v[2]]);
      }
      for (let c = 0; c < 4; c++) face(m, 4 * p + c, 6 * p, 6 * p + c + 1, 6 * p + c + 2);
    }
    return m;
  }
  function repeated(solid, poses, says) {
    const vertices = numbers(solid.vertices, Float32Array), n = vertices.length / 3, faces = numbers(solid.faces, n <= 65536 ? Uint16Array : Uint32Array), f = faces.length / 3;
    const m = mesh(n * poses.length, f * poses.length);
    poses.forEach((T, g) => {
      for (let v = 0; v < n; v++) put(m, g * n + v, moved(T, vertices[3 * v], vertices[3 * v + 1], vertices[3 * v + 2]));
      for (let t = 0; t < f; t++) face(m, g * f + t, g * n + faces[3 * t], g * n + faces[3 * t + 1], g * n + faces[3 * t + 2]);
    });
    return { ...m, text: poses.flatMap((_, g) => Array(n).fill(says[g])) };
  }

  // ---- layers -> traces
  const colour = () => document.querySelector("input[name=colour]:checked").value;
  const isShown = layer => switched[layer.name] ?? layer.on;
  const MATT = { ambient: 0.82, diffuse: 0.5, specular: 0.02, roughness: 0.9, fresnel: 0.02, facenormalsepsilon: 0, vertexnormalsepsilon: 0 };
  const made = { // what a layer looks like does not change while its demo is shown, so it is made once
    cloud: layer => ({ type: "mesh3d", ...hexagons(view.clouds[layer.cloud], layer.T), hoverinfo: "skip", lighting: MATT }),
    solid: layer => ({ type: "mesh3d", ...repeated(view.solids[layer.solid], layer.poses, layer.says), color: layer.color, opacity: layer.opacity,
      flatshading: true, lighting: MATT, hovertemplate: "%{text}<extra></extra>" }),
    lines: layer => {
      const ends = numbers(layer.ends, Float32Array), at = a => Array.from({ length: ends.length / 2 }, (_, i) => i % 3 === 2 ? null : ends[6 * Math.floor(i / 3) + 3 * (i % 3) + a]);
      return { type: "scatter3d", mode: "lines", x: at(0), y: at(1), z: at(2), line: { color: layer.color, width: 2 }, connectgaps: false,
        text: layer.says.flatMap(text => [text, text, ""]), hovertemplate: "%{text}<extra></extra>" };
    },
  };
  const coloured = layer => {
    const { values } = view.clouds[layer.cloud], name = values[colour()] ? colour() : "plain";
    const small = bytes(values[name]), intensity = new Float32Array(6 * small.length);
    for (let v = 0; v < intensity.length; v++) intensity[v] = small[Math.floor(v / 6)] / 255;
    return { intensity, colorscale: colours.find(c => c.name === name).scale, cmin: 0, cmax: 1, showscale: false };
  };
  function traces() {
    return view.layers.map(layer => {
      if (isShown(layer)) layer.trace ??= made[layer.kind](layer); // nothing is made before it is shown
      if (!layer.trace) return { type: "scatter3d", visible: false };
      return { ...layer.trace, ...(layer.kind === "cloud" ? coloured(layer) : {}), visible: isShown(layer), name: layer.name, showlegend: false };
    });
  }
  function draw(camera = stage.layout.scene.camera) {
    const ratio = 2.2 * view.reach / view.extent; // so that a metre is as long for each demo's own size, whatever is shown
    const axis = a => ({ visible: false, range: [view.center[a] - view.reach, view.center[a] + view.reach] });
    const layout = { margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)", modebar: { bgcolor: "rgba(0,0,0,0)", color: inked("--rule"), activecolor: inked("--soft") },
      hoverlabel: { bgcolor: inked("--paper"), bordercolor: inked("--soft"), font: { color: inked("--ink") } },
      scene: { xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), aspectmode: "manual", aspectratio: { x: ratio, y: ratio, z: ratio }, dragmode: "turntable", camera } };
    return Plotly.react(stage, traces(), layout, { ...CONFIG, modeBarButtons: [["toImage", "tableRotation", "pan3d"]] });
  }
  drawers.push(() => draw());

  // ---- where it is looked at from
  function from(direction) {
    const [x, y, z] = direction.map(part => DISTANCE * part / Math.hypot(...direction));
    return { eye: { x, y, z }, center: { x: 0, y: 0, z: 0 }, up: { x: 0, y: 0, z: 1 } };
  }
  const look = direction => Plotly.relayout(stage, { "scene.camera": from(direction) });
  function zoom(factor) {
    const now = stage.layout.scene.camera.eye;
    return Plotly.relayout(stage, { "scene.camera.eye": { x: now.x * factor, y: now.y * factor, z: now.z * factor } });
  }
  $("front").addEventListener("click", () => look(view.eye));
  $("above").addEventListener("click", () => look([0.15 * view.eye[0], 0.15 * view.eye[1], 1]));
  $("nearer").addEventListener("click", () => zoom(0.8));
  $("further").addEventListener("click", () => zoom(1.25));

  // ---- controls
  function show(chosen) {
    view = chosen;
    $("about").textContent = view.note;
    $("layers").replaceChildren($("layers").firstElementChild, ...view.layers.map(layer => {
      const box = element("input", { type: "checkbox", checked: isShown(layer), name: layer.name });
      box.addEventListener("change", () => { switched[layer.name] = box.checked; draw(); });
      const count = layer.poses && layer.solid === "object" ? ` (${layer.poses.length})` : layer.name === "correspondences" ? ` (${layer.says.length})` : "";
      const swatch = layer.color ? [element("i", { className: "swatch", style: `background: ${layer.color}` })] : [];
      return element("label", {}, box, layer.name + count, ...swatch);
    }));
    legend();
    return draw(from(view.eye));
  }
  function legend() {
    const { scale, ends, name } = colours.find(c => c.name === colour());
    $("scale").style.background = name === "superpoint" ? "none" : `linear-gradient(90deg, ${scale.map(([, c]) => c).join(", ")})`;
    $("ends").replaceChildren(...[ends[0], name === "height" ? view.top : ends[1]].map(text => element("span", { textContent: text })));
  }
  $("colours").append(...colours.map(({ name, title }) => element("label", {}, element("input", { type: "radio", name: "colour", value: name, checked: name === first }), title)),
    element("div", { id: "scale", className: "scale" }), element("div", { id: "ends", className: "ends" }));
  $("colours").addEventListener("change", () => { legend(); draw(); });
  $("demo").addEventListener("change", () => show(views[$("demo").selectedIndex]));

  // ---- links such as #view-12
  function follow() {
    const wanted = location.hash.match(/^#view-(\d+)$/), at = wanted ? views.findIndex(v => v.demo === Number(wanted[1])) : -1;
    if (at < 0) return false;
    $("demo").selectedIndex = at;
    show(views[at]);
    stage.closest("section").scrollIntoView();
    return true;
  }
  addEventListener("hashchange", follow);
  if (!follow()) show(views[0]);
});
