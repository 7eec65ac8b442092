// Shows the tables of one environment and protocol; without scripts all are shown.
const form = document.querySelector(".filter");
const boards = [...document.querySelectorAll(".board")];
const filter = () => {
  const { environment, protocol } = Object.fromEntries(new FormData(form));
  for (const board of boards) {
    board.hidden = (environment && board.dataset.environment !== environment)
      || (protocol && board.dataset.protocol !== protocol);
  }
  const shown = boards.filter((board) => !board.hidden).length;
  form.querySelector("output").textContent = `${shown} of ${boards.length} tables`;
};
form.hidden = boards.length < 2;
form.addEventListener("change", filter);
filter();
