# bash completion for emb-daemon: install -m 644 emb-daemon.bash /usr/share/bash-completion/completions/emb-daemon
_emb_daemon() {
    local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD - 1]} options=
    COMPREPLY=()
    if ((COMP_CWORD == 1)); then
        mapfile -t COMPREPLY < <(compgen -W "demo run check replay convert identify diagnose fleet effect simulate monitor files compile export uds xcp a2l bench adaptation --help --version" -- "$word")
        return
    fi
    case $before in
        --corner) mapfile -t COMPREPLY < <(compgen -W "FL FR RL RR" -- "$word"); return ;;
        -c | --channel) mapfile -t COMPREPLY < <(compgen -W "$(command ls /sys/class/net)" -- "$word"); return ;;
        -i | --interface) mapfile -t COMPREPLY < <(compgen -W "socketcan udp_multicast virtual" -- "$word"); return ;;
    esac
    case ${COMP_WORDS[1]} in
        demo) options="--corners --seconds --picture" ;;
        run) options="--config --mapping --share -i --interface -c --channel -b --bitrate --fd --bus-kwargs" ;;
        check) options="--config --mapping" ;;
        replay) options="--calibration --mapping --corner --from --to --pad-thickness --measured-torque --state --keys --output --report --json" ;;
        convert) options="--mapping --output" ;;
        identify) options="--mapping --output --report --example" ;;
        diagnose) options="--calibration --validate --output --mapping --corner" ;;
        fleet) options="" ;;
        effect) options="" ;;
        simulate) options="--corners --seconds --scenario --calibration --reference --mapping --keys --state --seed -i --interface -c --channel -b --bitrate --fd --bus-kwargs" ;;
        monitor) options="--once --json --web --record --udp --share --mapping -i --interface -c --channel -b --bitrate --fd --bus-kwargs" ;;
        files) options="" ;;
        compile) options="--output --target" ;;
        export) options="--calibration --output --kernels" ;;
        uds) options="--config --state --share --request-id --response-id -i --interface -c --channel -b --bitrate --fd --bus-kwargs" ;;
        xcp) options="--config --share --udp --can --request-id --response-id -i --interface -c --channel -b --bitrate --fd --bus-kwargs" ;;
        a2l) options="--config --output --udp --can --request-id --response-id -b --bitrate" ;;
        bench) options="--seconds --corners --json" ;;
        adaptation) options="--state --corner --yes" ;;
    esac
    if [[ $word == -* ]]; then
        mapfile -t COMPREPLY < <(compgen -W "$options --help" -- "$word")
    else
        mapfile -t COMPREPLY < <(compgen -f -- "$word")
    fi
}
complete -o filenames -F _emb_daemon emb-daemon
