// One button plays and pauses all videos, and one slider moves them; without scripts each has its
// own controls. Those on screen show the same moment; the others rest until they are scrolled to.
const player = document.querySelector(".player");
if (player) {
  const [button, slider] = player.querySelectorAll("button, input");
  const APART = 0.15, STILL = 0.02; // seconds that a video may be off, playing and paused
  const CALM = 2000, calm = new Map(); // milliseconds before a playing video is moved again
  let playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  let from = performance.now(); // when all were at their beginning
  let rested = 0; // where they were paused, in seconds

  // Pictures that move: a figure with its own video, or with panels of another figure's.
  const movieOf = (each) => (document.getElementById(each.dataset.of) ?? each).querySelector("video");
  const shown = new Set(), pictures = [...document.querySelectorAll(".video, .moving")].filter(movieOf);
  const movies = new Set(pictures.map(movieOf)), first = movieOf(pictures[0]);

  // The panels are of one size, which the video may magnify; a line divides them.
  function panels(figure) {
    const movie = movieOf(figure), { rows, columns, divider } = figure.dataset;
    if (movie.readyState < 2) return;
    for (const canvas of figure.querySelectorAll("canvas")) {
      const { width, height, dataset: { row, column } } = canvas, [line, across, down] = [divider, columns, rows].map(Number);
      const wide = movie.videoWidth / (across * (width + line) - line), high = movie.videoHeight / (down * (height + line) - line);
      const from = [column * (width + line) * wide, row * (height + line) * high, width * wide, height * high];
      canvas.getContext("2d").drawImage(movie, ...from, 0, 0, width, height);
    }
  }

  // Each dot follows its places, which are evenly spread over the video; NaN where nothing is seen.
  function trace(figure) {
    const movie = movieOf(figure), at = movie.duration ? movie.currentTime / movie.duration : 0;
    for (const dot of figure.querySelectorAll("circle")) {
      dot.places ??= dot.dataset.places.split(" ").map((each) => each.split(",").map(Number));
      const when = at * (dot.places.length - 1), [before, after] = [Math.floor(when), Math.ceil(when)].map((each) => dot.places[each]);
      const [x, y] = before.map((from, axis) => from + (when % 1) * (after[axis] - from));
      dot.style.display = x === x ? "" : "none";
      if (x === x) [["cx", x], ["cy", y]].forEach((each) => dot.setAttribute(...each));
    }
  }

  function draw(figure) {
    if (figure.dataset.of) return panels(figure), trace(figure);
    const movie = movieOf(figure), now = figure.querySelector(".now");
    const at = movie.duration ? movie.currentTime / movie.duration : 0;
    for (const end of now ? ["x1", "x2"] : []) now.setAttribute(end, at);
  }

  // Moves a video that is off, but not so often that a slow machine does nothing else. Between its
  // end and its beginning is no distance.
  function follow(movie, seconds) {
    if (!movie.duration) return;
    const due = seconds % movie.duration, off = Math.abs(movie.currentTime - due);
    const apart = Math.min(off, movie.duration - off) > (playing ? APART : STILL);
    if (apart && !movie.seeking && (!playing || performance.now() > (calm.get(movie) ?? 0))) {
      calm.set(movie, performance.now() + CALM);
      movie.currentTime = due;
    }
    if (playing && movie.paused) movie.play().catch(() => {});
    if (!playing) movie.pause();
  }

  const seconds = () => (playing ? (performance.now() - from) / 1000 : rested);

  function step() {
    const on = new Set([...shown].map(movieOf));
    for (const movie of movies) if (on.has(movie)) follow(movie, seconds()); else movie.pause();
    shown.forEach(draw);
    if (playing && first.duration) slider.value = (seconds() % first.duration) / first.duration;
    if (playing) requestAnimationFrame(step);
  }

  function put(value, at) {
    [playing, rested, from] = [value, at, performance.now() - 1000 * at];
    player.classList.toggle("paused", !playing);
    button.lastElementChild.textContent = playing ? "Pause" : "Play";
    step();
  }

  const toggle = () => put(!playing, seconds());
  button.addEventListener("click", toggle);
  slider.addEventListener("input", () => put(false, slider.value * (first.duration || 0)));
  for (const figure of pictures) {
    figure.hidden = false;
    (figure.querySelector(".screen") ?? figure).addEventListener("click", (event) => {
      if (!event.target.closest("a")) toggle();
    });
  }
  for (const movie of movies) {
    movie.controls = false;
    for (const event of ["loadeddata", "seeked"]) movie.addEventListener(event, () => { if (!playing) step(); });
  }
  player.hidden = false;
  const watcher = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) shown[isIntersecting ? "add" : "delete"](target);
    player.classList.toggle("idle", !shown.size);
    if (!playing) step();
  }, { threshold: 0.1 });
  pictures.forEach((each) => watcher.observe(each));
  put(playing, 0);
}
