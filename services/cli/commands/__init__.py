"""The table of commands: under what title `--help` shows each, the function that says its arguments, and its help.

A module of a command is imported when the command is asked for, so that `--help` and `--version` import none.
"""

COMMANDS = {
    "a scan": {
        "compress": ("compress:add_compress", "a scan into a packed file, previews and a report"),
        "inspect": ("inspect:add_inspect", "what a scan or a packed file is, and what is wrong with it"),
        "check": ("inspect:add_check", "what is wrong with a scan, from one pass over its points; exit 0 or 3"),
        "tradeoff": ("studies:add_tradeoff", "what accuracy costs on this scan: presets, and each knob alone, measured"),
        "estimate": ("studies:add_estimate", "what compress would take in seconds, memory and bytes, and give in PSNR"),
        "effects": ("effects:add_effects", "which effects a scan calls for, and what decided"),
        "evaluate": ("studies:add_evaluate", "the tables and figures of the HPG 2021 paper, measured on a scan with photographs"),
        "iso": ("looks:add_iso", "the histogram of a volume, and the iso values that it proposes"),
        "map": ("looks:add_map", "what each station of a laser scan saw, as pictures to edit"),
        "demo": ("compress:add_demo", "compress a scan that needs no download: a stereo pair, points or a volume"),
    },
    "a packed file": {
        "render": ("pictures:add_render", "pictures of a packed file"),
        "coverage": ("pictures:add_coverage", "holes and overdraw of a packed file's splats, view by view"),
        "report": ("compress:add_report", "measure a packed file against its scan"),
        "view": ("packed_files:add_view", "look at a packed file in the browser; Ctrl-C ends it"),
        "export": ("packed_files:add_export", "a packed file as what others open: points, Gaussians"),
        "pages": ("pages:add_pages", "the photographs of a scan as a page file, for views that are larger than memory"),
        "path": ("pages:add_path", "`path record`: a path for `fly`, from poses or one of the four of the paper"),
        "fly": ("pages:add_fly", "a recorded path, drawn; or which pages it would miss"),
    },
    "how large, how long": {
        "plan": ("studies:add_plan", "what a scan of any size would cost on any number of workers"),
    },
    "the shell": {
        "completion": ("completion:add_completion", "a script that completes commands and options in a shell"),
    },
    "the service": {
        "serve": ("service:add_service", "the whole service on this machine"),
        "api": ("service:add_service", "the web part of the service alone"),
        "runner": ("service:add_service", "the part that runs jobs alone"),
        "token": ("service:add_service", "make a token for an owner of scans and jobs"),
        "backup": ("service:add_service", "scans, jobs, results and tokens as one file, also while the service runs"),
        "restore": ("service:add_service", "a data folder from a backup; jobs that were under way go on"),
    },
    "a service's user": {
        "login": ("user:add_user", "remember a service and a token"),
        "logout": ("user:add_user", "forget service and token"),
        "upload": ("user:add_user", "upload a scan; prints its id"),
        "submit": ("user:add_user", "a job on a scan, by its id or its path; prints the job's id"),
        "watch": ("user:add_user", "live progress until a job has ended"),
        "status": ("user:add_user", "of a job"),
        "cancel": ("user:add_user", "dismiss a job"),
        "retry": ("user:add_user", "a job that failed or was dismissed"),
        "logs": ("user:add_user", "of a job"),
        "fetch": ("user:add_user", "what a job made"),
        "ls": ("user:add_user", "your jobs, newest first"),
        "regress": ("user:add_user", "run a list of jobs and compare with what is expected; exits 7 on a miss"),
    },
}  # fmt: skip
