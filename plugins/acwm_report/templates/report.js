// Videos play only while they are on screen, and not at all by themselves for those who asked for
// less motion; a line in the curves of the actions follows each video.
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const watcher = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (!isIntersecting) target.pause();
    else if (!still && !target.dataset.stopped) target.play().catch(() => {});
  }
}, { threshold: 0.25 });

for (const figure of document.querySelectorAll(".video")) {
  const video = figure.querySelector("video");
  const now = figure.querySelector(".now");
  if (still) { video.autoplay = false; video.pause(); }
  video.addEventListener("click", () => { video.dataset.stopped = video.paused ? "" : "1"; });
  watcher.observe(video);
  if (!now) continue;
  const follow = () => {
    const at = video.duration ? video.currentTime / video.duration : 0;
    now.setAttribute("x1", at);
    now.setAttribute("x2", at);
    if (!video.paused) requestAnimationFrame(follow);
  };
  for (const event of ["play", "seeked", "timeupdate"]) video.addEventListener(event, follow);
}

// A link to what lies in a folded section opens it.
const unfold = () => {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  for (let fold = target && target.closest("details"); fold; fold = fold.parentElement.closest("details")) {
    fold.open = true;
  }
  if (target) target.scrollIntoView();
};
addEventListener("hashchange", unfold);
unfold();

