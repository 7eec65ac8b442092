// Shows the tables of one environment, protocol and capability; without scripts all are shown.
const form = document.querySelector(".filter");
const boards = [...document.querySelectorAll(".board")];
const parts = [...document.querySelectorAll("[data-capability]")];
const filter = () => {
  const { environment, protocol, capability } = Object.fromEntries(new FormData(form));
  for (const part of parts) part.hidden = capability && part.dataset.capability !== capability;
  for (const board of boards) {
    board.hidden = (environment && board.dataset.environment !== environment)
      || (protocol && board.dataset.protocol !== protocol)
      || [...board.querySelectorAll("[data-capability]")].every((part) => part.hidden);
  }
  const shown = boards.filter((board) => !board.hidden).length;
  form.querySelector("output").textContent = `${shown} of ${boards.length} boards`;
};
form.hidden = boards.length < 2 && parts.length < 2;
form.addEventListener("change", filter);
filter();
