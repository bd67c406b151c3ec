// The film of a report: the scene as the superpoint that each pixel sees, in the colours of the scores of a step.
document.addEventListener("plotting", async () => {
  const film = content("film"), $ = id => document.getElementById(id), slider = $("step"), box = slider.closest(".film");
  const arrayOf = async text => (await unpacked(text).arrayBuffer());
  const superpoint = new Uint16Array(await arrayOf(film.superpoint)), shade = new Uint8Array(await arrayOf(film.shade));
  const scores = film.scores.map(text => new Int8Array(bytes(text).buffer));
  const colour = score => { // piecewise linear over the scale, which runs from -1 to 1
    const at = (score / 127 + 1) / 2 * (film.scale.length - 1), i = Math.min(Math.floor(at), film.scale.length - 2);
    return film.scale[i].map((c, k) => c + (film.scale[i + 1][k] - c) * (at - i));
  };
  function paint(canvas, row, step) {
    canvas.width = film.width;
    canvas.height = film.height;
    const context = canvas.getContext("2d"), picture = context.createImageData(film.width, film.height), pixels = picture.data;
    const colours = Array.from({ length: film.count }, (_, s) => colour(scores[row][step * film.count + s]));
    for (let p = 0; p < superpoint.length; p++) {
      if (!shade[p]) continue;
      const c = colours[superpoint[p]], light = shade[p] / 255;
      for (let k = 0; k < 3; k++) pixels[4 * p + k] = c[k] * light;
      pixels[4 * p + 3] = 255;
    }
    context.putImageData(picture, 0, 0);
  }
  const large = [...box.querySelectorAll(".cards canvas")];
  function show() {
    const step = Math.min(Number(slider.value), film.steps.length - 1), placed = Number(slider.value) === film.steps.length;
    large.forEach((canvas, row) => paint(canvas, row, step));
    box.classList.toggle("placed", placed);
    $("steps").textContent = placed ? "object placed" : film.steps[step];
  }
  slider.addEventListener("input", show);
  let timer = null;
  $("play").addEventListener("click", () => {
    clearInterval(timer);
    slider.value = 0;
    show();
    timer = setInterval(() => {
      slider.value = Number(slider.value) + 1;
      show();
      if (slider.value === slider.max) clearInterval(timer);
    }, 180);
  });
  const go = step => ({ onclick: () => { clearInterval(timer); slider.value = step; show(); } });
  $("strip").style.gridTemplateColumns = `auto repeat(${film.strip.length + 1}, minmax(64px, 1fr))`;
  $("strip").append(...["", ...film.strip.map(step => film.steps[step]), "object placed"].map(text => element("span", { textContent: text })));
  box.querySelectorAll(".cards img").forEach((placed, row) => {
    const thumbs = film.strip.map(step => element("canvas", go(step)));
    thumbs.forEach((canvas, i) => paint(canvas, row, film.strip[i]));
    $("strip").append(element("span", { textContent: row + 1 }), ...thumbs, element("img", { src: placed.src, alt: placed.alt, ...go(film.steps.length) }));
  });
  show();
});
