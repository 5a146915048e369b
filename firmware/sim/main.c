/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* skinsim: runs an unchanged AVR firmware with a tactile skin attached. */
#include "skinsim.h"

#include <getopt.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int usage(void) {
    fprintf(stderr, "usage: skinsim --board uno|megaatmega2560 [--bootloader HEX] [--pins PINS] "
                    "[--pty] ELF\n");
    return 2;
}

int main(int argc, char **argv) {
    static const struct option OPTIONS[] = {{"board", required_argument, NULL, 'b'},
                                            {"bootloader", required_argument, NULL, 'l'},
                                            {"pins", required_argument, NULL, 'w'},
                                            {"pty", no_argument, NULL, 'p'},
                                            {0}};
    const struct board *board = NULL;
    const char *loader = NULL, *pins = NULL;
    bool pty = false;
    for (int option; (option = getopt_long(argc, argv, "", OPTIONS, NULL)) != -1;) {
        if (option == 'b')
            board = skin_find_board(optarg);
        else if (option == 'l')
            loader = optarg;
        else if (option == 'w')
            pins = optarg;
        else if (option == 'p')
            pty = true;
        else
            return usage();
        if (!board && option == 'b')
            return usage();
    }
    if (board && loader && !strcmp(loader, "board"))
        loader = board->loader;
    if (!board || optind != argc - 1)
        return usage();
    struct board wired = *board;
    if (!wiring_of_firmware(argv[optind], &wired) ||
        (pins && !wiring_of_option(pins, &wired.wiring)))
        return 2;

    /* libsimavr prints on stdout; only replies may go there. */
    const int replies = dup(STDOUT_FILENO);
    if (replies < 0 || dup2(STDERR_FILENO, STDOUT_FILENO) < 0) {
        perror("skinsim");
        return 1;
    }
    signal(SIGPIPE, SIG_IGN);
    control_start(STDIN_FILENO, replies);
    if (!cpu_start(&wired, argv[optind], loader))
        return 1;
    if (pty)
        return pty_run();
    while (control_serve_one(false) == CONTROL_OK)
        ;
    return 0;
}
